"""Photos added to a finished scene: only what is new is made, the model stays, nothing gets lost."""

import dataclasses
import json
import logging
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from rendered_scene import CONFIG
from scene_to_grow import SceneToGrow, contents, make_scene_to_grow

import corrsfm.features.stage
import corrsfm.finished.add as adding
import corrsfm.finished.grown_models as grown_models
from corrsfm import config as cfg
from corrsfm.cli import main
from corrsfm.colmap.models import poses_of
from corrsfm.errors import CorrsfmError, ImageError, InputError, WorkspaceError
from corrsfm.finished.add import add_photos
from corrsfm.finished.incoming import find_photos
from corrsfm.finished.integrity import find_damage
from corrsfm.geometry import relative_pose, rotation_angle_deg
from corrsfm.pipeline import run_scene
from corrsfm.report.stage import report
from corrsfm.workspace import Workspace

RUN = CONFIG.run


def interrupt(scene: SceneToGrow, monkeypatch: pytest.MonkeyPatch, where: object, step: str) -> None:
    """Begin an addition that is interrupted when it comes to a step."""

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(where, step, stop)
        add_photos(scene.workspace, scene.new, run=RUN)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> SceneToGrow:
    return make_scene_to_grow(tmp_path_factory.mktemp("grow"))


@pytest.fixture
def scene(made: SceneToGrow, tmp_path: Path) -> SceneToGrow:
    return made.copy(tmp_path / "own")


@pytest.fixture(scope="module")
def grown(made: SceneToGrow, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SceneToGrow]:
    scene = made.copy(tmp_path_factory.mktemp("grown") / "own")
    result = add_photos(scene.workspace, scene.new, run=RUN)
    assert [photo.model for photo in result.photos] == [0, 0]
    yield scene


def raw(model: pycolmap.Reconstruction) -> dict[str, list[float]]:
    """Numbers of poses and cameras, exactly."""
    poses = {name: [*r.ravel(), *t] for name, (r, t) in poses_of(model).items()}
    return poses | {f"camera {i}": list(camera.params) for i, camera in model.cameras.items()}


def test_only_the_new_photos_and_their_pairs_are_computed(
    scene: SceneToGrow, monkeypatch: pytest.MonkeyPatch
) -> None:
    extracted = []
    create = corrsfm.features.stage.create_extractor

    def counting(config: cfg.FeaturesConfig, device: str):  # type: ignore[no-untyped-def]
        extract = create(config, device)

        def count(*arguments):  # type: ignore[no-untyped-def]
            extracted.append(1)
            return extract(*arguments)

        return count

    monkeypatch.setattr(corrsfm.features.stage, "create_extractor", counting)
    result = add_photos(scene.workspace, scene.new, run=RUN)
    assert len(extracted) == 2
    assert result.num_new_pairs == 2 * 5 + 1
    records = {stage: Workspace(scene.workspace).record_of(stage) for stage in ("matches", "pruned matches")}
    assert all(record is not None and record.num_reused == 10 for record in records.values())
    assert [photo.name for photo in result.photos] == scene.new_names
    assert result.report is not None and result.report.num_registered == 7


def test_the_model_does_not_move_by_a_bit(made: SceneToGrow, grown: SceneToGrow) -> None:
    before, after = made.model(), grown.model()
    kept = raw(before)
    assert len(kept) == 6
    assert {name: values for name, values in raw(after).items() if name in kept} == kept
    assert before.num_points3D() > 50
    for point_id, point in before.points3D.items():
        assert list(point.xyz) == list(after.points3D[point_id].xyz)
        assert list(point.color) == list(after.points3D[point_id].color)


def test_the_new_photos_stand_where_they_were_taken(grown: SceneToGrow) -> None:
    found, truth = poses_of(grown.model()), poses_of(pycolmap.Reconstruction(grown.truth))
    old = [name for name in found if name not in grown.new_names]
    for new in grown.new_names:
        for other in old:
            rotation, translation = relative_pose(*found[other], *found[new])
            rotation_true, translation_true = relative_pose(*truth[other], *truth[new])
            cosine = translation @ translation_true
            cosine /= np.linalg.norm(translation) * np.linalg.norm(translation_true)
            assert rotation_angle_deg(rotation_true.T @ rotation) < 0.5
            assert np.degrees(np.arccos(min(cosine, 1.0))) < 1.0


def test_database_and_model_agree_about_ids_and_keypoints(grown: SceneToGrow) -> None:
    model = grown.model()
    with pycolmap.Database.open(grown.workspace / "database.db") as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        cameras = {image.name: image.camera_id for image in database.read_all_images()}
        for image in model.images.values():
            assert (ids[image.name], cameras[image.name]) == (image.image_id, image.camera_id)
            keypoints = database.read_keypoints(image.image_id)[:, :2]
            np.testing.assert_array_equal(keypoints, [point.xy for point in image.points2D])


def test_report_verdict_and_page_tell_of_the_new_photos(grown: SceneToGrow) -> None:
    report = json.loads((grown.workspace / "report.json").read_text())
    assert report["summary"]["num_registered"] == 7 and report["verdict"]["grade"] == "good"
    assert report["added"] == grown.new_names
    remarks = json.loads((grown.workspace / "cameras.json").read_text())["remarks"]
    assert remarks[-1] == f"added with the camera of photos like them: {', '.join(grown.new_names)}"
    assert grown.new_names[0] in (grown.workspace / "report.html").read_text()


def test_a_later_run_keeps_the_addition_and_says_so(
    grown: SceneToGrow, caplog: pytest.LogCaptureFixture
) -> None:
    before = contents(grown.workspace / "sparse")
    with caplog.at_level(logging.INFO, "corrsfm"):
        report = run_scene(grown.photos, grown.workspace, CONFIG)
    assert contents(grown.workspace / "sparse") == before
    assert "photos added to them without mapping again are kept: 2" in caplog.text
    assert report.num_registered == 7


def test_mapping_again_keeps_a_copy_and_says_that_poses_move(
    scene: SceneToGrow, caplog: pytest.LogCaptureFixture
) -> None:
    add_photos(scene.workspace, scene.new, run=RUN)
    before = contents(scene.workspace / "sparse")
    config = dataclasses.replace(CONFIG, run=dataclasses.replace(RUN, seed=4))
    run_scene(scene.photos, scene.workspace, config)
    assert contents(scene.workspace / "sparse.old") == before
    assert "all photos are mapped again now and every pose moves" in caplog.text
    assert not (scene.workspace / "added.json").exists()


def test_a_lost_list_of_pairs_comes_back_as_the_addition_left_it(grown: SceneToGrow, tmp_path: Path) -> None:
    scene = grown.copy(tmp_path / "own")
    before = contents(scene.workspace)
    (scene.workspace / "pairs.txt").unlink()
    run_scene(scene.photos, scene.workspace, CONFIG)
    after = contents(scene.workspace)
    lists = ("pairs.txt", "pair_origins.tsv", "added.json", "sparse/0/images.bin")
    assert [after[name] for name in lists] == [before[name] for name in lists]


@pytest.mark.parametrize("name", ["pair_origins.tsv", "database.db"])
def test_what_an_addition_made_is_not_replaced_silently(
    name: str, grown: SceneToGrow, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = grown.copy(tmp_path / "own")
    before = contents(scene.workspace / "sparse")
    (scene.workspace / name).unlink()
    run_scene(scene.photos, scene.workspace, CONFIG)
    if name == "database.db":
        # Another database may call photos and cameras by other numbers.
        assert "every pose moves" in caplog.text
        assert contents(scene.workspace / "sparse.old") == before
    else:
        assert "those that corrsfm add chose are not kept" in caplog.text
        assert contents(scene.workspace / "sparse") == before


def test_the_loss_of_the_verdict_costs_no_model_that_photos_were_added_to(
    grown: SceneToGrow, tmp_path: Path
) -> None:
    scene = grown.copy(tmp_path / "own")
    workspace = Workspace(scene.workspace)
    before = contents(workspace.sparse)
    workspace.evidence.write_text("{")
    (damage,) = find_damage(workspace)
    assert damage.problem.endswith("the verdict is lost, the models are not")
    assert damage.remedy == f"rm -rf {workspace.evidence}; corrsfm report {workspace.root}"
    workspace.evidence.unlink()
    report(Workspace(scene.workspace))
    assert not find_damage(Workspace(scene.workspace))
    assert contents(workspace.sparse) == before
    (workspace.sparse / "0" / "points3D.bin").write_bytes(b"")
    (damage,) = find_damage(Workspace(scene.workspace))
    assert "mapped again every pose moves, and a copy of them is kept" in damage.problem


@pytest.mark.parametrize("content", [None, "", '{"photos": {"a.jpg": 3}}'])
def test_the_loss_of_what_is_known_of_added_photos_costs_no_model(
    content: str | None, grown: SceneToGrow, tmp_path: Path
) -> None:
    scene = grown.copy(tmp_path / "own")
    workspace = Workspace(scene.workspace)
    before = contents(workspace.sparse)
    workspace.added.unlink()
    if content is not None:
        workspace.added.write_text(content)
    (damage,) = find_damage(workspace)
    assert damage.problem.endswith("what it says of added photos is lost, the models are not")
    removal, again = damage.remedy.split("; ")
    assert removal == f"rm -rf {workspace.added}" and again == f"corrsfm report {workspace.root}"
    workspace.added.unlink(missing_ok=True)
    report(Workspace(scene.workspace))
    assert not find_damage(Workspace(scene.workspace))
    assert contents(workspace.sparse) == before


def test_the_seed_of_the_last_run_is_that_of_the_addition(scene: SceneToGrow) -> None:
    config = dataclasses.replace(CONFIG, run=dataclasses.replace(RUN, seed=4))
    run_scene(scene.photos, scene.workspace, config)
    add_photos(scene.workspace, scene.new, run=RUN)
    before = contents(scene.workspace / "sparse")
    run_scene(scene.photos, scene.workspace, config)
    assert contents(scene.workspace / "sparse") == before


def test_refine_moves_what_is_there(made: SceneToGrow, scene: SceneToGrow) -> None:
    result = add_photos(scene.workspace, scene.new, refine=True, run=RUN)
    assert all(photo.model == 0 for photo in result.photos)
    kept = raw(made.model())
    assert {name: values for name, values in raw(scene.model()).items() if name in kept} != kept


@pytest.mark.parametrize(
    "step",
    ["extract_features", "match_pairs", "prune_matches", "add_to_database", "grow", "record_of", "report"],
)
def test_an_interrupted_addition_goes_on_where_it_was(
    scene: SceneToGrow, grown: SceneToGrow, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt(scene, monkeypatch, grown_models if hasattr(grown_models, step) else adding, step)
    if step != "report":
        with pytest.raises(WorkspaceError, match="run: corrsfm add"):
            Workspace(scene.workspace).require("models")
    result = add_photos(scene.workspace, run=RUN)
    assert [photo.model for photo in result.photos] == [0, 0]
    assert not (scene.workspace / "adding.json").exists()
    assert raw(scene.model()) == raw(grown.model())
    assert all(photo.num_inliers > 15 for photo in result.photos)


def test_an_interruption_while_models_are_replaced_loses_none(
    scene: SceneToGrow, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt(scene, monkeypatch, grown_models, "grow")
    (scene.workspace / "sparse").rename(scene.workspace / ".sparse.corrsfm.old")
    result = add_photos(scene.workspace, run=RUN)
    assert [photo.model for photo in result.photos] == [0, 0]


def test_a_run_after_such_an_interruption_finds_the_models(scene: SceneToGrow) -> None:
    before = contents(scene.workspace / "sparse")
    (scene.workspace / "sparse").rename(scene.workspace / ".sparse.corrsfm.old")
    with Workspace(scene.workspace).lock():
        assert contents(scene.workspace / "sparse") == before


def test_masks_beside_the_photos_do_not_join(scene: SceneToGrow) -> None:
    masks = scene.photos / "masks"
    masks.mkdir()
    for photo in scene.photos.glob("*.png"):
        assert cv2.imwrite(str(masks / f"{photo.name}.png"), np.full((8, 8), 255, np.uint8))
    found = find_photos(scene.photos, scene.photos, mask_dir=masks)
    assert [photo.name for photo in found] == sorted(path.name for path in scene.photos.glob("*.png"))


def test_a_photo_that_is_a_link_goes_by_its_own_name(tmp_path: Path) -> None:
    (tmp_path / "photos" / "left").mkdir(parents=True)
    (tmp_path / "elsewhere.jpg").write_bytes(b"photo")
    (tmp_path / "photos" / "left" / "1.jpg").symlink_to(tmp_path / "elsewhere.jpg")
    (tmp_path / "in.jpg").symlink_to(tmp_path / "photos" / "left" / "1.jpg")
    (photo,) = find_photos(tmp_path / "photos" / "left" / "1.jpg", tmp_path / "photos")
    assert photo.name == "left/1.jpg"


def test_a_photo_exchanged_during_an_addition_is_named_and_nothing_is_made_of_it(
    scene: SceneToGrow, grown: SceneToGrow, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt(scene, monkeypatch, adding._Addition, "finish")
    name = scene.new_names[0]
    for content in ((scene.new / scene.new_names[1]).read_bytes(), b"cut"):
        (scene.photos / name).write_bytes(content)
        with pytest.raises(InputError, match=f"no longer the photos that were to be added: {name}"):
            add_photos(scene.workspace, run=RUN)
    (scene.photos / name).unlink()
    add_photos(scene.workspace, scene.new, run=RUN)
    assert raw(scene.model()) == raw(grown.model())


@pytest.mark.parametrize(
    "content", ["[]", '{"photos": 5, "options": {}}', '{"photos": {"a": 1}, "options": {}}']
)
def test_a_damaged_note_of_an_addition_is_named(scene: SceneToGrow, content: str) -> None:
    (scene.workspace / "adding.json").write_text(content)
    with pytest.raises(WorkspaceError, match=r"adding\.json: damaged .* remove it, with: rm "):
        add_photos(scene.workspace, run=RUN)


def damage(scene: SceneToGrow, how: str) -> None:
    path = scene.workspace / "sparse" / "0"
    if how == "cut off":
        os.truncate(path / "points3D.bin", 100)
        return
    model = pycolmap.Reconstruction(path)
    if how == "of other photos":
        next(iter(model.images.values())).name = "stranger.png"
    else:
        next(iter(model.cameras.values())).height += 1
    model.write(path)


@pytest.mark.parametrize("how", ["cut off", "of other photos", "of other sizes"])
def test_nothing_is_added_to_a_damaged_model(scene: SceneToGrow, how: str) -> None:
    damage(scene, how)
    before = contents(scene.photos), contents(scene.workspace)
    with pytest.raises(WorkspaceError, match=r"corrsfm reconstruct .* --overwrite"):
        add_photos(scene.workspace, scene.new, run=RUN)
    assert (contents(scene.photos), contents(scene.workspace)) == before


def test_a_model_damaged_during_an_addition_is_made_again_by_the_commands_that_are_named(
    scene: SceneToGrow, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt(scene, monkeypatch, adding, "match_pairs")
    damage(scene, "cut off")
    with pytest.raises(WorkspaceError, match="damaged") as told:
        add_photos(scene.workspace, run=RUN)
    for command in str(told.value).partition("again with: ")[2].split("; "):
        words = shlex.split(command)
        if words[0] == "rm":
            Path(words[1]).unlink()
        else:
            assert CliRunner().invoke(main, [*words[1:], "--threads", "1"]).exit_code == 0, command
    assert len(scene.model().images) == 7


def test_photos_in_the_folder_of_the_scene_are_used_where_they_are(scene: SceneToGrow) -> None:
    (scene.photos / "later").mkdir()
    for name in scene.new_names:
        shutil.copy2(scene.new / name, scene.photos / "later" / name)
    result = add_photos(scene.workspace, [scene.photos / "later"], run=RUN)
    assert [photo.name for photo in result.photos] == [f"later/{name}" for name in scene.new_names]
    assert not (scene.photos / scene.new_names[0]).exists()
    assert result.report is not None and result.report.num_registered == 7


def test_a_photo_of_elsewhere_is_named_with_a_reason_and_a_next_step(
    scene: SceneToGrow, tmp_path: Path, made: SceneToGrow
) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (768, 1024), np.uint8)
    assert cv2.imwrite(str(tmp_path / "noise.png"), noise)
    result = add_photos(scene.workspace, tmp_path / "noise.png", run=RUN)
    (photo,) = result.photos
    assert photo.model is None and photo.reason and "corrsfm" in photo.next_step
    assert result.report is not None
    assert [missing.name for missing in result.report.missing] == ["noise.png"]
    assert raw(scene.model()) == raw(made.model())
    again = add_photos(scene.workspace, tmp_path / "noise.png", run=RUN)
    assert again.already_there == ("noise.png",) and again.photos == result.photos


def test_photos_that_are_there_already_are_nothing_to_do(scene: SceneToGrow) -> None:
    before = contents(scene.workspace.parent)
    result = add_photos(scene.workspace, scene.photos, run=RUN)
    assert not result.photos and len(result.already_there) == 5 and result.report is None
    assert contents(scene.workspace.parent) == before


def test_a_heic_photo_joins_as_a_jpeg_and_is_known_again(scene: SceneToGrow, tmp_path: Path) -> None:
    image_module = pytest.importorskip("PIL.Image")
    pytest.importorskip("PIL.AvifImagePlugin")
    name = Path(scene.new_names[0])
    modern = tmp_path / f"{name.stem}.avif"
    with image_module.open(scene.new / name) as photo:
        photo.convert("RGB").save(modern, quality=95)
    result = add_photos(scene.workspace, modern, run=RUN)
    assert [(photo.name, photo.model) for photo in result.photos] == [(f"{name.stem}.jpg", 0)]
    assert cv2.imread(str(scene.photos / f"{name.stem}.jpg")) is not None
    assert add_photos(scene.workspace, modern, run=RUN).already_there == (f"{name.stem}.jpg",)


def test_photos_beside_frames_of_a_video_come_with_the_command_that_keeps_them(
    scene: SceneToGrow, caplog: pytest.LogCaptureFixture
) -> None:
    workspace = Workspace(scene.workspace)
    shutil.copytree(scene.photos, workspace.frames)
    workspace.remember_photos([str(scene.photos.with_name("film.mp4"))], workspace.frames)
    add_photos(scene.workspace, scene.new, run=RUN)
    (command,) = re.findall(r"film.mp4 leaves the new photos out; to go on with them: (.*)", caplog.text)
    assert command.startswith(f"corrsfm extract {workspace.frames} {scene.workspace} ")
    before = contents(workspace.sparse)
    assert run_scene(workspace.frames, scene.workspace, CONFIG).num_registered == 7
    assert contents(workspace.sparse) == before


def refused(scene: SceneToGrow, photos: object, error: type[CorrsfmError], text: str) -> None:
    before = contents(scene.workspace.parent)
    with pytest.raises(error, match=text):
        add_photos(scene.workspace, photos, run=RUN)  # type: ignore[arg-type]
    assert contents(scene.workspace.parent) == before


def test_what_cannot_be_added_is_refused_and_nothing_changes(scene: SceneToGrow, tmp_path: Path) -> None:
    known = sorted(path.name for path in scene.photos.iterdir())[0]
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy2(scene.new / scene.new_names[0], other / known)
    refused(scene, other, InputError, f"another photo of the name {known}")
    (tmp_path / "broken.jpg").write_bytes(b"not a photo")
    refused(scene, [tmp_path / "broken.jpg", scene.new], ImageError, "broken.jpg")
    (tmp_path / "empty").mkdir()
    refused(scene, tmp_path / "empty", InputError, "no photos")
    refused(scene, (), InputError, "no photos to add")
    refused(scene, tmp_path / "nowhere.jpg", InputError, "no such photo or folder")
    (tmp_path / "film.mp4").write_bytes(b"")
    refused(scene, tmp_path / "film.mp4", InputError, "is a video; take its frames with: corrsfm extract")
    scene.photos.rename(scene.photos.with_name("moved"))
    refused(scene, scene.new, InputError, "is not there; mount it")


def test_a_changed_or_lost_photo_of_the_scene_stops_the_addition(scene: SceneToGrow) -> None:
    known = sorted(scene.photos.iterdir())[0]
    shutil.copy2(scene.new / scene.new_names[0], known)
    refused(scene, scene.new / scene.new_names[1], InputError, f"were changed since: {known.name}")
    known.unlink()
    refused(scene, scene.new / scene.new_names[1], InputError, f"are not there any more: {known.name}")


def test_an_unfinished_or_locked_workspace_is_refused(scene: SceneToGrow, tmp_path: Path) -> None:
    with Workspace(scene.workspace).lock():
        refused(scene, scene.new, WorkspaceError, "another corrsfm works")
    Workspace(scene.workspace).forget("models")
    refused(scene, scene.new, WorkspaceError, "no models yet; run: corrsfm reconstruct")
    with pytest.raises(WorkspaceError, match="not a corrsfm workspace"):
        add_photos(tmp_path, scene.new)
