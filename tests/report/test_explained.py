"""The section of the page on what the model explains."""

import json
import re
from pathlib import Path

import cv2
import numpy as np

from corrsfm.report import make_report
from corrsfm.report.explained import explained_pairs, photos_to_show
from corrsfm.report.pictures import draw_shares, share_colours


def pair(name0: str, name1: str, verified: int, explained: int, registered: bool = True, **more: str) -> dict:
    counts = {"num_verified": verified, "num_explained": explained, "registered": registered}
    return {"name0": name0, "name1": name1, **counts, **more}


def section_of(names, pairs, contradicted=(), *more, **evidence) -> str:
    record = {"pairs": pairs, "contradicted_pairs": list(contradicted), **evidence}
    return explained_pairs(
        make_report(scene="x", image_names=names, pairs=[], models=[], evidence=record), *more
    )


def data_of(section: str) -> dict:
    found = re.search(r'id="pair-data">(.*?)</script>', section)
    assert found is not None
    return json.loads(found[1])


def test_each_verified_pair_has_its_counts_under_the_pointer() -> None:
    against = pair("b.jpg", "c.jpg", 1000, 100)
    pairs = [pair("a.jpg", "b.jpg", 50, 50), against, pair("a.jpg", "d.jpg", 20, 0, registered=False)]
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    section = section_of(names, pairs, [against], folds={"left_out": [["c.jpg", "d.jpg"]]})
    data = data_of(section)
    assert data["names"] == names
    assert {(row, column): text for row, column, text in data["pairs"]} == {
        (0, 1): "50 of 50 verified matches explained",
        (1, 2): "100 of 1,000 verified matches explained, contradicts the model",
        (0, 3): "20 verified; not both photos are in the model",
        (2, 3): "left out, because it joins places that look alike",
    }
    assert "<b>1 of 3 verified pairs</b> contradicts it" in section
    assert "150 of 1,070 verified matches" in section


def test_contradicted_pairs_are_crossed_out_on_both_sides_of_the_diagonal() -> None:
    against = pair("a", "b", 10, 1)
    crossed = section_of("abc", [against, pair("b", "c", 10, 9)], [against])
    path = re.search(r'class="mark"[^>]* d="([^"]*)"', crossed)
    assert path is not None and path[1].count("M") == 2
    plain = section_of("abc", [pair("b", "c", 10, 9)])
    assert 'class="mark"' not in plain and "No pair contradicts it." in plain


def test_without_a_record_of_pairs_there_is_no_section() -> None:
    report = make_report(scene="x", image_names="ab", pairs=[], models=[])
    assert explained_pairs(report) == section_of("ab", []) == ""


def test_names_cannot_end_the_script_that_holds_them() -> None:
    names = ["</script><b>.jpg", "é.jpg"]
    section = section_of(names, [pair(*names, 10, 9)])
    assert "</script><b>" not in section
    assert data_of(section)["names"] == names


def test_a_large_scene_shows_the_photos_with_most_contradicted_matches_and_says_so() -> None:
    names = [f"{number:03d}" for number in range(250)]
    pairs = [pair(names[i], names[i + 1], 10, 10) for i in range(249)]
    against = pair("005", "249", 90, 3)
    section = section_of(names, [*pairs, against], [against])
    shown = data_of(section)["names"]
    assert len(shown) == 200 and shown == sorted(shown) and {"005", "249"} <= set(shown)
    assert "200 of 250 photos are shown" in section
    assert '<li value="250">249</li>' in section
    assert photos_to_show(names, [against], [], 2) == ["005", "249"]


def test_next_come_the_photos_with_most_unexplained_matches() -> None:
    pairs = [pair("a", "b", 10, 10), pair("c", "d", 10, 6), pair("a", "d", 10, 9)]
    assert photos_to_show("abcd", [], pairs, 2) == ["c", "d"]


def test_shares_go_from_red_to_green_and_differ_in_lightness() -> None:
    red, middle, green = (share_colours(np.array(share)).astype(int) for share in (0.0, 0.5, 1.0))
    assert red[2] > red[1] and green[1] > green[2]
    lightness = cv2.cvtColor(np.uint8([[red, middle, green]]), cv2.COLOR_BGR2LAB)[0, :, 0].astype(int)
    assert lightness[0] + 40 < lightness[2] < lightness[1]


def test_matrix_is_white_where_nothing_is_verified_and_grey_where_the_model_says_nothing() -> None:
    drawn = draw_shares("abc", [("a", "b", 1.0), ("c", "a", None)])
    np.testing.assert_array_equal(drawn, drawn.transpose(1, 0, 2))
    assert drawn[0, 1].tolist() == share_colours(np.array(1.0)).tolist()
    assert drawn[0, 2].tolist() == [222, 222, 222]
    assert drawn[0, 0].tolist() == drawn[1, 2].tolist() == [255, 255, 255]


def test_contradicted_pairs_are_drawn_with_their_matches_if_the_record_tells_which(tmp_path: Path) -> None:
    for name in "abc":
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((40, 60, 3), np.uint8))
    points = np.array([[10.5, 10.5], [30.5, 20.5]], np.float32)
    told = pair("a.png", "b.png", 2, 0, explained_matches="01")
    stale = pair("a.png", "c.png", 3, 1, explained_matches="001")
    untold = pair("b.png", "c.png", 2, 0)
    against = [told, stale, untold]
    names = ["a.png", "b.png", "c.png"]
    section = section_of(names, against, against, tmp_path, lambda *_: (points, points))
    assert section.count('<img class="wide"') == 1
    assert "<b>a.png – b.png</b> 0 of 2 verified matches explained" in section
    assert section.count("<tr><td>") == 3
    gone = section_of(names, against, against, tmp_path / "gone", lambda *_: (points, points))
    assert '<img class="wide"' not in gone


def test_pairs_that_fold_a_model_are_drawn(tmp_path: Path) -> None:
    for name in "ab":
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((40, 60, 3), np.uint8))
    none = np.zeros((0, 2), np.float32)
    pairs = [pair("a.png", "b.png", 20, 20)]
    folds = {"folded": True, "worst_pairs": [{"name0": "a.png", "name1": "b.png"}], "left_out": []}
    args = (["a.png", "b.png"], pairs, [], tmp_path, lambda *_: (none, none))
    assert "the model is folded there" in section_of(*args, folds=folds)
    assert '<img class="wide"' not in section_of(*args, folds=folds | {"folded": False})
