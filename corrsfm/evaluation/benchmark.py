"""Speed and memory of the network, as ratios to the plainly written published network.

Absolute times depend on the machine and its load. Reference and network take turns in the same run, so that
their ratios depend on it much less.
"""

from __future__ import annotations

import ctypes
import itertools
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from corrsfm.config import Precision
from corrsfm.model import CorrAdaptor, NetworkConfig, Rival, load_network
from corrsfm.model.plain import PlainCorrAdaptor

__all__ = ["BenchmarkRow", "format_rows", "run_benchmark"]

_MIB = 1 << 20


@dataclass(frozen=True, kw_only=True)
class BenchmarkRow:
    """One measurement.

    Attributes
    ----------
    device : str
        cpu or cuda.
    num_matches : int
        Matches of each pair.
    batch_size : int
        Pairs at a time.
    variant : str
        ``reference`` (the published network, plain, float32), ``float32``, ``bfloat16``, or one of the last
        two with ``compiled``.
    pairs_per_second : float
        From the median time of the repetitions.
    peak_mib : float or None
        Memory that a batch needs beyond weights and input, MiB; None if the system does not report it.
    speed_ratio : float
        Pairs per second over those of the reference.
    memory_ratio : float or None
        Peak memory over that of the reference.
    """

    device: str
    num_matches: int
    batch_size: int
    variant: str
    pairs_per_second: float
    peak_mib: float | None
    speed_ratio: float
    memory_ratio: float | None


def run_benchmark(
    *,
    model: Path | None = None,
    devices: Sequence[str] = ("cpu",),
    sizes: Sequence[int] = (500, 1000, 2000),
    batch_sizes: Sequence[int] = (1,),
    precisions: Sequence[Precision] = (Precision.FLOAT32, Precision.BFLOAT16),
    compile: bool = False,
    repeats: int = 3,
    seed: int = 0,
) -> list[BenchmarkRow]:
    """Measure the network.

    Parameters
    ----------
    model : Path, optional
        Checkpoint of any network. If not given, CorrAdaptor as published with fresh weights: as fast.
    devices : sequence of str
    sizes : sequence of int
        Matches a pair.
    batch_sizes : sequence of int
    precisions : sequence of Precision
    compile : bool
        Also measure the compiled network.
    repeats : int
        Timed repetitions of each variant, after a warm-up.
    seed : int
        Seed of the random matches.

    Returns
    -------
    list of BenchmarkRow
        Grouped by device, size and batch size; the reference first in each group.
    """
    network: CorrAdaptor | Rival = (
        load_network(model) if model is not None else CorrAdaptor.from_config(NetworkConfig()).eval()
    )
    reference = PlainCorrAdaptor().eval()
    rows: list[BenchmarkRow] = []
    for device, size, batch_size in itertools.product(devices, sizes, batch_sizes):
        network, reference = network.to(device), reference.to(device)
        generator = torch.Generator().manual_seed(seed)
        coordinates = torch.rand(batch_size, size, 4, generator=generator).sub(0.5).to(device)
        side = None
        if network.side_channels:
            side = torch.rand(batch_size, size, network.side_channels, generator=generator).to(device)
        variants = _variants(reference, network, precisions, compile, torch.device(device))
        measured = _measure(variants, (coordinates, side), repeats, torch.device(device))
        rows.extend(_rows(measured, device, size, batch_size))
    return rows


def _variants(
    reference: PlainCorrAdaptor,
    network: CorrAdaptor | Rival,
    precisions: Sequence[Precision],
    compile: bool,
    device: torch.device,
) -> dict[str, Callable]:
    """Variants by name, the reference first: functions of coordinates and side information."""

    def rounded(forward: Callable) -> Callable:
        def run(*inputs: torch.Tensor | None) -> object:
            with torch.autocast(device.type, torch.bfloat16):
                return forward(*inputs)

        return run

    variants: dict[str, Callable] = {"reference": lambda coordinates, _: reference(coordinates)}
    forwards: dict[str, Callable] = {"": network}
    if compile:
        forwards[" compiled"] = torch.compile(network)
    for precision, (suffix, forward) in itertools.product(precisions, forwards.items()):
        variants[f"{precision}{suffix}"] = rounded(forward) if precision is Precision.BFLOAT16 else forward
    return variants


def _measure(
    variants: dict[str, Callable],
    inputs: tuple[torch.Tensor, torch.Tensor | None],
    repeats: int,
    device: torch.device,
) -> dict[str, tuple[float, float | None]]:
    """Median seconds and peak bytes of each variant; they take turns, so that a busy moment hits all."""
    seconds: dict[str, list[float]] = {name: [] for name in variants}
    peaks: dict[str, float | None] = {}
    with torch.inference_mode():
        for name, run in variants.items():  # warm-up, and the only round that measures memory
            run(*inputs)
            with _PeakMemory(device) as peak:
                run(*inputs)
            peaks[name] = peak.bytes
        for _ in range(repeats):
            for name, run in variants.items():
                _synchronise(device)
                start = time.perf_counter()
                run(*inputs)
                _synchronise(device)
                seconds[name].append(time.perf_counter() - start)
    return {name: (statistics.median(seconds[name]), peaks[name]) for name in variants}


def _synchronise(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class _PeakMemory:
    """Peak memory inside the block, beyond what was in use at its start."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._before: float | None = None
        self.bytes: float | None = None

    def __enter__(self) -> _PeakMemory:
        if self._device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self._device)
            self._before = torch.cuda.memory_allocated(self._device)
        else:
            self._before = _reset_peak_rss()
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is None:
            return
        if self._device.type == "cuda":
            self.bytes = torch.cuda.max_memory_allocated(self._device) - self._before
        else:
            peak = _status_bytes("VmHWM")
            self.bytes = None if peak is None else peak - self._before


def _reset_peak_rss() -> float | None:
    """Reset the process's peak memory and return its current use; None where the system cannot."""
    try:
        # Freed memory that the allocator still holds would hide what the next run needs.
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, AttributeError):
        return None
    return _status_bytes("VmRSS")


def _status_bytes(key: str) -> float | None:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return float(line.split()[1]) * 1024
    return None


def _rows(
    measured: dict[str, tuple[float, float | None]], device: str, size: int, batch_size: int
) -> list[BenchmarkRow]:
    reference_seconds, reference_peak = measured["reference"]
    return [
        BenchmarkRow(
            device=device,
            num_matches=size,
            batch_size=batch_size,
            variant=variant,
            pairs_per_second=batch_size / seconds,
            peak_mib=None if peak is None else peak / _MIB,
            speed_ratio=reference_seconds / seconds,
            memory_ratio=peak / reference_peak if peak is not None and reference_peak else None,
        )
        for variant, (seconds, peak) in measured.items()
    ]


def format_rows(rows: Sequence[BenchmarkRow]) -> str:
    """Rows as a table for the terminal."""
    columns = f"{'device':<8}{'matches':>8}{'batch':>7}  {'variant':<19}{'pairs/s':>9}{'×':>7}"
    lines = [columns + f"{'peak MiB':>10}{'×':>7}"]
    for row in rows:
        peak = "–" if row.peak_mib is None else f"{row.peak_mib:.0f}"
        share = "–" if row.memory_ratio is None else f"{row.memory_ratio:.2f}"
        lines.append(
            f"{row.device:<8}{row.num_matches:>8}{row.batch_size:>7}  {row.variant:<19}"
            f"{row.pairs_per_second:>9.2f}{row.speed_ratio:>7.2f}{peak:>10}{share:>7}"
        )
    return "\n".join(lines)
