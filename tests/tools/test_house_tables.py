"""What the project measures of itself, as tables and a picture."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

from corrsfm.evaluation.records import load_results
from tools.house_tables import HOUSE_TABLES, draw_growth, keep_row


def growth_row(num: int) -> dict:
    names = ("photos", "matches", "kept matches", "database")
    steps = {name: {"seconds": num / 1000, "peak_gib": 0.3 + num / 1e5} for name in names}
    return {
        "num_photos": num, "num_pairs": 20 * num, "first run": steps, "nothing to do": steps,
        "one more pair": steps, "bytes": {"features.db": 4000 * num},
    }  # fmt: skip


@pytest.fixture
def growth(tmp_path: Path) -> dict:
    path = tmp_path / "growth.json"
    for num in (10_000, 1_000, 10_000):
        keep_row(path, "growth", f"{num} photos", growth_row(num), command="python tools/growth.py")
    return load_results(path, "growth")


def test_growth_is_a_table_in_the_order_of_size(growth: dict) -> None:
    table = HOUSE_TABLES["growth"](growth)
    assert table.rows == [
        ["1,000", "20,000", "4", "4", "4", "3.0", "0.31", "0.00"],
        ["10,000", "200,000", "40", "40", "40", "30.0", "0.40", "0.04"],
    ]


def test_growth_is_drawn(growth: dict) -> None:
    root = ElementTree.fromstring(draw_growth(growth))
    texts = [element.text for element in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"1,000", "10,000", "first run", "nothing to do", "one more pair"} <= set(texts)
    lines = [element.get("points") for element in root.iter("{http://www.w3.org/2000/svg}polyline")]
    assert len(lines) == 4
    # Ten times the photos take ten times as long: higher up.
    heights = [float(point.split(",")[1]) for point in lines[0].split()]
    assert heights[1] < heights[0]


def test_reliability_is_a_table(tmp_path: Path) -> None:
    path = tmp_path / "reliability.json"
    keep_row(
        path, "reliability", "bad inputs", {"number": 512, "faults": 0, "counted": "a traceback"}, command="x"
    )
    table = HOUSE_TABLES["reliability"](load_results(path))
    assert table.rows == [["bad inputs", "512", "0", "a traceback"]]
