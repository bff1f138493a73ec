"""The HTML page of a report."""

import base64
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from corrsfm.colmap.models import summarise_model
from corrsfm.report import StageWarning, make_report
from corrsfm.report.charts import histogram
from corrsfm.report.page import write_html
from corrsfm.report.pictures import draw_matches, draw_view_graph, read_photo, view_graph_scale
from corrsfm.types import PairStatistics

EXTERNAL = re.compile(
    r"""(?:src|href|action|poster|data)\s*=\s*["']?\s*(?:https?:|//)|@import|url\(\s*["']?(?:https?:|//)""",
    re.IGNORECASE,
)


@pytest.fixture(scope="module")
def model() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=80
        )
    )


def names(model: pycolmap.Reconstruction) -> list[str]:
    return sorted(image.name for image in model.images.values())


def matches(model: pycolmap.Reconstruction):
    """Every point seen by both photos, the first half kept."""
    images = {image.name: image for image in model.images.values()}

    def load(name0: str, name1: str):
        seen = [
            {point.point3D_id: point.xy for point in images[name].get_observation_points2D()}
            for name in (name0, name1)
        ]
        common = sorted(seen[0].keys() & seen[1].keys())
        points = [np.array([part[key] for key in common], np.float32) for part in seen]
        return points[0], points[1], np.arange(len(common)) < len(common) // 2

    return load


def report_of(model: pycolmap.Reconstruction, **changes):
    photos = names(model)
    pairs = [
        PairStatistics(name0=a, name1=b, num_putative=80, num_kept=40, num_verified=39 - 5 * i - j)
        for i, a in enumerate(photos)
        for j, b in enumerate(photos)
        if a < b
    ]
    facts = {
        "scene": "synthetic",
        "image_names": [*photos, "lost & found.png"],
        "pairs": pairs,
        "models": [summarise_model(model)],
        "stage_seconds": {"features": 2.0, "models": 0.5},
        "configuration": {"prune": {"method": "loransac"}},
        "versions": {"corrsfm": "0.1.0"},
    }
    return make_report(**(facts | changes))


@pytest.fixture
def photos(model: pycolmap.Reconstruction, tmp_path: Path) -> Path:
    folder = tmp_path / "images"
    folder.mkdir()
    for name in [*names(model), "lost & found.png"]:
        cv2.imwrite(str(folder / name), np.full((768, 1024, 3), 90, np.uint8))
    return folder


def page(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def without_scripts(text: str) -> str:
    return re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)


def test_page_is_complete_and_loads_nothing(model, photos: Path, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_html(report_of(model), path, model=model, images_dir=photos, load_matches=matches(model))
    text = page(path)
    visible = without_scripts(text)
    assert not EXTERNAL.search(visible)
    assert re.findall(r"<(?:link|iframe|object|embed|base)\b", visible) == []
    assert not re.search(r"<script[^>]*\bsrc\b", text)
    assert "default-src 'none'" in text
    for heading in ("Model", "Statistics", "Distributions", "View graph", "Matches", "Run"):
        assert f"<h2>{heading}</h2>" in visible
    assert visible.count("<b>strong</b>") == 2
    assert visible.count("<b>weak</b>") == 3
    assert visible.count("<figure>") == 3 + 1 + 5
    assert "4 / 5" in visible
    assert path.stat().st_size < 8e6


def test_photos_that_are_missing_are_shown_with_their_reason(model, photos: Path, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_html(report_of(model), path, images_dir=photos)
    text = page(path)
    assert "1 photo is not registered" in text
    row = text[text.index('<table class="missing">') :]
    assert "lost &amp; found.png" in row
    assert "<b>no pair</b>" in row
    assert row.index("data:image/jpeg;base64,") < row.index("lost &amp;")


def test_page_needs_neither_plotly_nor_photos(model, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "plotly.io", None)
    path = tmp_path / "report.html"
    write_html(report_of(model), path, model=model, images_dir=tmp_path / "gone", load_matches=matches(model))
    text = page(path)
    assert "pip install 'corrsfm[report]'" in text
    assert "<script" not in text
    assert path.stat().st_size < 3e5
    encoded = re.search(r'class="wide" src="data:image/png;base64,([^"]+)"', text)
    assert encoded is not None
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(encoded[1]), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (480, 960, 3)
    assert (picture == (0, 94, 213)).all(axis=2).sum() > 100, "no camera in the still view"


def test_page_of_a_failed_reconstruction_is_written(tmp_path: Path) -> None:
    report = make_report(scene="<dark>", image_names=["a.jpg", "b.jpg"], pairs=[], models=[])
    write_html(report, tmp_path / "report.html")
    text = page(tmp_path / "report.html")
    assert "<h1>&lt;dark&gt;</h1>" in text
    assert "0 / 2" in text
    assert "No pair of photos was matched." in text
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_same_facts_give_the_same_page(model, photos: Path, tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        write_html(
            report_of(model), tmp_path / name, model=model, images_dir=photos, load_matches=matches(model)
        )
    assert page(tmp_path / "a.html") == page(tmp_path / "b.html")


def test_kept_matches_are_blue_and_dropped_ones_orange() -> None:
    photo = np.zeros((100, 120, 3), np.uint8)
    points0 = np.array([[20.5, 30.5], [20.5, 70.5]], np.float32)
    drawn = draw_matches((photo, photo), (1.0, 1.0), (points0, points0), np.array([True, False]))
    assert drawn.shape == (100, 246, 3)
    for column in (20, 100, 146):
        # Lines are smoothed against the photo.
        np.testing.assert_allclose(drawn[30, column], [233, 180, 86], atol=25)
        np.testing.assert_allclose(drawn[70, column], [0, 94, 213], atol=25)
    assert drawn[50, 60].tolist() == [64, 64, 64]


def test_no_match_at_all_can_be_drawn() -> None:
    photo = np.zeros((10, 10, 3), np.uint8)
    none = np.zeros((0, 2), np.float32)
    assert draw_matches((photo, photo), (1.0, 1.0), (none, none), np.zeros(0, bool)).shape == (10, 26, 3)


def test_view_graph_is_white_grey_or_darker_with_more_matches() -> None:
    def pair(name0: str, name1: str, verified: int) -> PairStatistics:
        return PairStatistics(name0=name0, name1=name1, num_putative=900, num_kept=500, num_verified=verified)

    pairs = [pair("a", "b", 20), pair("a", "c", 100), pair("d", "b", 400), pair("c", "d", 0)]
    picture = draw_view_graph("abcd", pairs)
    assert view_graph_scale(pairs) == (20, 400)
    np.testing.assert_array_equal(picture, picture.transpose(1, 0, 2))
    assert picture[0, 0].tolist() == picture[0, 3].tolist() == [255, 255, 255]
    assert picture[2, 3].tolist() == [222, 222, 222]
    brightness = [
        cv2.cvtColor(picture[row, column][None, None], cv2.COLOR_BGR2GRAY).item()
        for row, column in ((0, 1), (0, 2), (1, 3))
    ]
    assert brightness == sorted(brightness, reverse=True)
    assert brightness[0] - brightness[2] > 100


def test_view_graph_of_many_photos_stays_small() -> None:
    many = [f"{index:04d}" for index in range(1200)]
    pairs = [PairStatistics(name0=many[0], name1=many[-1], num_putative=9, num_kept=9, num_verified=9)]
    picture = draw_view_graph(many, pairs)
    assert picture.shape == (500, 500, 3)
    assert (picture[0, -1] != 255).any()


def test_photo_is_read_as_stored_and_scaled(tmp_path: Path) -> None:
    wide = np.zeros((50, 200, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "größe.png"), wide)
    photo, scale = read_photo(tmp_path / "größe.png", 100)
    assert photo.shape == (25, 100, 3)
    assert scale == 0.5
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff nothing")
    (tmp_path / "empty.jpg").write_bytes(b"")
    assert read_photo(tmp_path / "broken.jpg", 100) is None
    assert read_photo(tmp_path / "empty.jpg", 100) is None
    assert read_photo(tmp_path / "gone.jpg", 100) is None


def test_histogram_counts_every_value_once() -> None:
    drawn = histogram([0.5, 1.5, 1.5, 7.0], np.array([0.0, 1.0, 2.0, 3.0]), "error", "points")
    assert re.findall(r"<title>(.*?)</title>", drawn) == ["0 to 1: 1", "1 to 2: 2", "2 or more: 1"]


def test_without_a_model_the_page_says_so_above_the_numbers(tmp_path: Path) -> None:
    pairs = [PairStatistics(name0="a<", name1="b", num_putative=50, num_kept=9, num_verified=0)]
    write_html(
        make_report(scene="x", image_names=["a<", "b"], pairs=pairs, models=[]), tmp_path / "page.html"
    )
    text = (tmp_path / "page.html").read_text()
    verdict = (
        '<div class="verdict wrong"><h2>There is no model</h2>'
        "<ul><li>2 of 2 photos: too few verified matches</li></ul>"
        "<h3>What to try next</h3>"
        "<ul><li>take a photo between a&lt; and b, or try a larger --max-features</li></ul>"
    )
    assert text.index(verdict) < text.index('<div class="tiles">')


def test_the_verdict_stands_above_the_numbers_with_what_was_tried(tmp_path: Path) -> None:
    evidence = {
        "verdict": {"grade": "doubtful", "reasons": ["9 of 10 <b>photos"], "next_steps": ["more photos"]},
        "explained_share": 0.9,
        "num_predicted_matches": 12345,
        "models_tried": [{}, {}],
        "folds": {"left_out": [["a.jpg", "b.jpg"]]},
    }
    made = make_report(scene="x", image_names=["a.jpg", "b.jpg"], pairs=[], models=[], evidence=evidence)
    write_html(made, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    verdict = (
        '<div class="verdict doubtful"><h2>The model is doubtful</h2>'
        "<ul><li>9 of 10 &lt;b&gt;photos</li></ul>"
        "<h3>What to try next</h3><ul><li>more photos</li></ul>"
    )
    assert text.index(verdict) < text.index('<div class="tiles">')
    assert "2 models were tried; this one predicts 12,345 matches; 1 pair of look-alike places left" in text
    plain = made.to_dict()
    assert plain["verdict"]["grade"] == plain["summary"]["verdict"] == "doubtful"
    assert plain["summary"]["num_predicted_matches"] == 12345


def test_a_model_that_was_taken_as_it_came_has_no_verdict(tmp_path: Path) -> None:
    made = make_report(scene="x", image_names=["a.jpg", "b.jpg"], pairs=[], models=[])
    write_html(made, tmp_path / "page.html")
    assert '<p class="verdict' not in (tmp_path / "page.html").read_text()
    assert made.to_dict()["verdict"] is None and made.to_dict()["summary"]["verdict"] is None


def test_what_the_run_warned_of_is_on_the_page_and_nothing_where_it_did_not(tmp_path: Path) -> None:
    said = [StageWarning(stage="images", message="ignored a<b>.heic\nconvert it")]
    made = make_report(scene="x", image_names=["a.jpg", "b.jpg"], pairs=[], models=[], warnings=said)
    write_html(made, tmp_path / "page.html")
    assert "<h2>What the run warned of</h2>" in page(tmp_path / "page.html")
    assert 'images</th><td class="lines">ignored a&lt;b&gt;.heic\nconvert it</td>' in page(
        tmp_path / "page.html"
    )
    assert made.to_dict()["warnings"] == [{"stage": "images", "message": "ignored a<b>.heic\nconvert it"}]
    quiet = make_report(scene="x", image_names=["a.jpg", "b.jpg"], pairs=[], models=[])
    write_html(quiet, tmp_path / "page.html")
    assert "What the run warned of" not in page(tmp_path / "page.html")
    assert quiet.to_dict()["warnings"] == []


def test_pairs_without_a_verified_match_are_counted_and_not_drawn(tmp_path: Path) -> None:
    def pair(name0: str, name1: str, verified: int) -> PairStatistics:
        return PairStatistics(name0=name0, name1=name1, num_putative=90, num_kept=40, num_verified=verified)

    pairs = [pair("a", "b", 30), pair("a", "c", 0), pair("b", "c", 0)]
    write_html(make_report(scene="x", image_names="abc", pairs=pairs, models=[]), tmp_path / "page.html")
    text = page(tmp_path / "page.html")
    assert "2 pairs have no verified match and no inlier ratio." in text
    bars = dict(re.findall(r"<title>([\d.]+ to [\d.]+): (\d+)</title>", text))
    assert bars["0 to 0.05"] == "0" and bars["0.75 to 0.8"] == "1" and sum(map(int, bars.values())) == 1
