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


def fold_run(auc5: float, *, unfolded_from: float | None = None, still_folded: bool = False) -> dict:
    run = {
        "auc5": auc5,
        "num_photos": 14,
        "unfolded_by": None,
        "still_folded": still_folded,
        "num_in_place": 13,
    }
    if unfolded_from is not None:
        run |= {"unfolded_by": "unfolded-votes", "without": {"auc5": unfolded_from, "folded": True}}
    return run


def test_folds_are_a_table_of_the_scenes_that_have_some() -> None:
    mug = [fold_run(90, unfolded_from=30), fold_run(40, still_folded=True), fold_run(80, unfolded_from=20)]
    table = HOUSE_TABLES["folds"]({"rows": {"mug": mug, "relief": [fold_run(99), fold_run(98)]}})
    assert table.rows == [["mug", "14", "2 of 3", "0 of 3", "1 of 3", "13", "30.0 (20.0)", "80.0 (40.0)"]]
    assert "On 1 other scenes, in 2 runs" in table.caption
