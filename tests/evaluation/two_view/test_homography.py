"""Homography evaluation on a small made-up folder: one texture warped by known homographies."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from corrsfm.cli import main
from corrsfm.errors import InputError
from corrsfm.evaluation.records import load_results
from corrsfm.evaluation.two_view.homography import (
    EXCLUDED_SEQUENCES,
    evaluate_homography,
    list_sequences,
    load_sequence,
)

HOMOGRAPHIES = {
    2: np.array([[1.0, 0, 12], [0, 1, -7], [0, 0, 1]]),
    3: np.array([[0.9, -0.2, 30], [0.2, 0.9, -10], [1e-4, 0, 1]]),
}


def _write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))


def _texture() -> np.ndarray:
    generator = np.random.default_rng(0)
    image = np.zeros((240, 320), np.float32)
    for size, weight in ((8, 1.0), (24, 1.0), (64, 0.6)):
        noise = generator.random((240 * size // 240 * 3, 320 * size // 240 * 3), np.float32)
        image += weight * cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("hpatches")
    for name in ("v_plane", "i_plane", "v_talent"):
        (root / name).mkdir()
        _write(root / name / "1.ppm", _texture())
        for number, homography in HOMOGRAPHIES.items():
            if name == "i_plane":
                homography = np.eye(3)
            image = cv2.warpPerspective(_texture(), homography, (320, 240))
            _write(root / name / f"{number}.ppm", (image * 0.8).astype(np.uint8))
            np.savetxt(root / name / f"H_1_{number}", homography)
    return root


def test_sequences_that_the_literature_leaves_out_are_left_out(folder: Path):
    assert [path.name for path in list_sequences(folder)] == ["i_plane", "v_plane"]
    assert len(EXCLUDED_SEQUENCES) == 8


def test_matches_are_labelled_by_the_true_homography(folder: Path):
    pairs = load_sequence(folder / "v_plane")
    assert [pair.name for pair in pairs] == ["v_plane 1-2", "v_plane 1-3"]
    shift = pairs[0].matches
    seen, right = shift.as_correspondences(), shift.inliers()
    assert right.sum() > 100
    moved = seen.points1[right] - seen.points0[right]
    # The threshold is 3 px at 480, here 1.5 px.
    assert np.abs(moved - [12, -7]).max() < 1.5
    assert np.abs(np.median(moved, axis=0) - [12, -7]).max() < 0.05
    assert np.abs(shift.correspondences).max() <= 1.0


def test_filters_find_the_homographies(folder: Path, tmp_path: Path):
    values = evaluate_homography(
        folder,
        ["ratio0.8+mutual", "oracle"],
        results=tmp_path / "h.json",
        command="corrsfm evaluate homography",
    )
    assert values["subject"]["sequences"] == ["i_plane", "v_plane"]
    for name in ("ratio0.8+mutual", "oracle"):
        summary = values["methods"][name]["summary"]
        assert (summary["num_pairs"], summary["num_failed"]) == (4, 0)
        assert summary["auc"]["3"] > 85
        assert {"auc_illumination", "auc_viewpoint"} <= set(summary)
    assert load_results(tmp_path / "h.json", "homography")["methods"] == values["methods"]


def test_second_run_measures_only_what_is_new(folder: Path, tmp_path: Path):
    results = tmp_path / "h.json"
    evaluate_homography(folder, ["oracle"], results=results)
    seen: list[str] = []
    evaluate_homography(
        folder, ["oracle"], results=results, on_sequence=lambda name, total: seen.append(name)
    )
    assert seen == []
    evaluate_homography(
        folder, ["nn", "oracle"], results=results, on_sequence=lambda name, total: seen.append(name)
    )
    assert seen == ["i_plane", "v_plane"]
    assert set(load_results(results)["methods"]) == {"nn", "oracle"}
    values = load_results(results)
    values["methods"]["nn"]["summary"]["auc"] = {"3": "x"}
    (tmp_path / "damaged.json").write_text(json.dumps(values, indent=1))
    with pytest.raises(InputError, match=r"damaged\.json: "):
        evaluate_homography(folder, ["nn"], results=tmp_path / "damaged.json")
    changed = tmp_path / "changed" / folder.name
    shutil.copytree(folder, changed)
    _write(changed / "v_plane" / "2.ppm", np.full((240, 320), 128, np.uint8))
    with pytest.raises(InputError, match="measured on"):
        evaluate_homography(changed, ["oracle"], results=results)


def test_no_matches_is_a_failure_not_a_crash(tmp_path: Path):
    (tmp_path / "v_blank").mkdir()
    for number in (1, 2):
        _write(tmp_path / "v_blank" / f"{number}.png", np.full((100, 120), 128, np.uint8))
    np.savetxt(tmp_path / "v_blank" / "H_1_2", np.eye(3))
    summary = evaluate_homography(tmp_path, ["nn"])["methods"]["nn"]["summary"]
    assert (summary["num_failed"], summary["auc"]["10"]) == (1, 0.0)


def test_folders_that_are_no_hpatches_are_explained(tmp_path: Path):
    with pytest.raises(InputError, match=r"no sequences found; expected HPatches' layout"):
        list_sequences(tmp_path)
    (tmp_path / "v_a").mkdir()
    (tmp_path / "v_a" / "H_1_2").write_text("1 2 3")
    with pytest.raises(InputError, match=r"v_a: no photo 1\.ppm"):
        load_sequence(tmp_path / "v_a")
    for number in (1, 2):
        _write(tmp_path / "v_a" / f"{number}.png", _texture())
    (tmp_path / "v_a" / "H_1_2~").write_text("a backup")
    for text in ("1 2 3", "nan " * 9, "0 " * 9, "1 2 3 " * 3, "x " * 9):
        (tmp_path / "v_a" / "H_1_2").write_text(text)
        with pytest.raises(InputError, match=r"H_1_2: not a homography"):
            load_sequence(tmp_path / "v_a")


def test_command_prints_the_table(folder: Path, tmp_path: Path):
    command = [
        "evaluate",
        "homography",
        str(folder),
        "--filter",
        "oracle",
        "--results",
        str(tmp_path / "h.json"),
    ]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 0, result.output
    assert "| oracle |" in result.output and "2 sequences." in result.output
