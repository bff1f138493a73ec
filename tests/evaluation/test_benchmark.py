import json

import pytest
import torch
from click.testing import CliRunner

from corrsfm.cli.bench import bench
from corrsfm.config import Precision
from corrsfm.evaluation import benchmark
from corrsfm.evaluation.benchmark import BenchmarkRow, format_rows, run_benchmark
from corrsfm.model import CorrAdaptor, NetworkConfig, save_network
from corrsfm.model.plain import PlainCorrAdaptor

SMALL = {"channels": 16, "clusters": 12, "heads": 2, "neighbors": (6, 3), "motion_stacking": 1}


@pytest.fixture
def checkpoint(tmp_path, monkeypatch):
    """A small network and a small reference; the published one takes seconds."""
    monkeypatch.setattr(benchmark, "PlainCorrAdaptor", lambda: PlainCorrAdaptor(**SMALL))
    path = tmp_path / "small.pt"
    save_network(CorrAdaptor.from_config(NetworkConfig(**SMALL, side_channels=2)), path)
    return path


def test_every_size_and_variant_is_measured_beside_the_reference(checkpoint):
    rows = run_benchmark(model=checkpoint, sizes=(64, 128), batch_sizes=(1, 2), repeats=1)
    groups = [(row.num_matches, row.batch_size, row.variant) for row in rows]
    assert groups == [
        (size, batch, variant)
        for size in (64, 128)
        for batch in (1, 2)
        for variant in ("reference", "float32", "bfloat16")
    ]
    for row in rows:
        assert row.pairs_per_second > 0
        assert row.speed_ratio > 0
    assert all(row.speed_ratio == 1 for row in rows if row.variant == "reference")


def test_ratios_are_those_of_the_same_group():
    rows = benchmark._rows(
        {"reference": (2.0, 400.0 * 2**20), "float32": (0.5, 100.0 * 2**20), "bfloat16": (0.25, None)},
        "cpu",
        1000,
        4,
    )
    assert [row.pairs_per_second for row in rows] == [2.0, 8.0, 16.0]
    assert [row.speed_ratio for row in rows] == [1.0, 4.0, 8.0]
    assert [row.memory_ratio for row in rows] == [1.0, 0.25, None]
    assert [row.peak_mib for row in rows] == [400.0, 100.0, None]


def test_peak_memory_sees_a_large_tensor():
    with benchmark._PeakMemory(torch.device("cpu")) as peak:
        torch.ones(64 * 2**20 // 4).sum()
    if peak.bytes is None:
        pytest.skip("this system does not tell a process's peak memory")
    assert 50 < peak.bytes / 2**20 < 120


def test_table_has_a_line_for_each_row_and_dashes_for_what_is_unknown():
    row = BenchmarkRow(
        device="cpu",
        num_matches=2000,
        batch_size=1,
        variant="float32",
        pairs_per_second=3.456,
        peak_mib=None,
        speed_ratio=2.5,
        memory_ratio=None,
    )
    header, line = format_rows([row]).splitlines()
    assert header.split() == ["device", "matches", "batch", "variant", "pairs/s", "×", "peak", "MiB", "×"]
    assert line.split() == ["cpu", "2000", "1", "float32", "3.46", "2.50", "–", "–"]


def test_command_prints_json(checkpoint):
    outcome = CliRunner().invoke(
        bench,
        ["--model", str(checkpoint), "--num-matches", "64", "--precision", "float32", "--repeats", "1"]
        + ["--device", "cpu", "--threads", "1", "--json"],
    )
    assert outcome.exit_code == 0, outcome.output
    rows = json.loads(outcome.stdout)
    assert [row["variant"] for row in rows] == ["reference", "float32"]
    assert Precision(rows[1]["variant"]) is Precision.FLOAT32
