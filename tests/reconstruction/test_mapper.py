"""Mapping a database into models."""

import ctypes
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from corrsfm.colmap.models import observation_errors, read_models, summarise_model
from corrsfm.config import Mapper, ReconstructionConfig
from corrsfm.errors import DatabaseError, ReconstructionError, WorkspaceError
from corrsfm.reconstruction import mapper as reconstruction
from corrsfm.reconstruction.mapper import _ranked, reconstruct, threads_for

MODEL_FILES = ["cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin"]


def synthesize(path: Path, num_images: int = 10, num_points: int = 100, **options) -> pycolmap.Reconstruction:
    """A database of exact matches, and its true model."""
    pycolmap.set_random_seed(0)
    with pycolmap.Database.open(path) as database:
        return pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(
                num_rigs=1,
                num_cameras_per_rig=1,
                num_frames_per_rig=num_images,
                num_points3D=num_points,
                **options,
            ),
            database,
        )


def two_worlds(path: Path, sizes: tuple[int, int]) -> None:
    """A database of two scenes that share no photo pair; names of the second begin with ``b_``."""
    parts = []
    for size, letter in zip(sizes, "ab", strict=True):
        part = path.with_name(f"{letter}.db")
        synthesize(part, size)
        database = pycolmap.Database.open(part)
        for image in database.read_all_images():
            image.name = f"{letter}_{image.image_id:02d}.jpg"
            database.update_image(image)
        parts.append(database)
    with pycolmap.Database.open(path) as merged:
        pycolmap.Database.merge(*parts, merged)
    for database in parts:
        database.close()


def run(database: Path, output: Path, images_dir: Path | None = None, **options):
    arguments = {
        key: options.pop(key) for key in ("seed", "num_threads", "on_progress", "log_file") if key in options
    }
    return reconstruct(database, images_dir, output, config=ReconstructionConfig(**options), **arguments)


@pytest.mark.parametrize("mapper", list(Mapper))
def test_every_mapper_recovers_the_synthetic_scene(tmp_path: Path, mapper: Mapper) -> None:
    truth = synthesize(tmp_path / "database.db")
    (summary,) = run(tmp_path / "database.db", tmp_path / "sparse", mapper=mapper)
    assert summary.num_images == 10
    assert summary.image_names == tuple(sorted(image.name for image in truth.images.values()))
    assert (summary.num_points, summary.num_observations) == (100, 1000)
    assert (summary.mean_track_length, summary.mean_observations_per_image) == (10.0, 100.0)
    assert summary.p95_error_px < 1e-2
    (model,) = read_models(tmp_path / "sparse")
    assert summarise_model(model).image_names == summary.image_names
    compared = pycolmap.compare_reconstructions(truth, model)
    errors = compared["errors"] if isinstance(compared, dict) else compared.errors
    assert max(error.rotation_error_deg for error in errors) < 0.01
    assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db", "sparse"]
    assert [path.name for path in (tmp_path / "sparse").iterdir()] == ["0"]
    assert sorted(path.name for path in (tmp_path / "sparse/0").iterdir()) == MODEL_FILES


def test_nothing_is_printed_and_the_log_is_kept(tmp_path: Path, capfd) -> None:
    synthesize(tmp_path / "database.db")
    # What pycolmap printed in earlier tests may still wait in the buffer of the C library.
    ctypes.CDLL(None).fflush(None)
    capfd.readouterr()
    for mapper in Mapper:
        run(tmp_path / "database.db", tmp_path / "sparse", mapper=mapper)
        assert capfd.readouterr() == ("", "")
    run(tmp_path / "database.db", tmp_path / "sparse", log_file=tmp_path / "log.txt")
    assert capfd.readouterr() == ("", "")
    assert "Registering image" in (tmp_path / "log.txt").read_text()


def test_mapping_that_runs_out_of_time_keeps_what_there_is_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    synthesize(tmp_path / "database.db")
    (summary,) = run(
        tmp_path / "database.db",
        tmp_path / "sparse",
        max_runtime_minutes=1 / 60,
        on_progress=lambda num_registered: time.sleep(1.1 if num_registered == 4 else 0),
    )
    assert 4 <= summary.num_images < 10
    (text,) = caplog.messages
    assert text.startswith("mapping was stopped after --max-runtime-minutes 0.0166667; photos may be missing")


def test_mapping_within_its_time_says_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    synthesize(tmp_path / "database.db")
    run(tmp_path / "database.db", tmp_path / "sparse", max_runtime_minutes=10)
    assert not caplog.messages


def test_no_model_for_lack_of_time_is_not_blamed_on_the_photos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synthesize(tmp_path / "database.db")
    monkeypatch.setattr(reconstruction, "_run_mapper", lambda *_, **__: time.sleep(1.1) or {})
    with pytest.raises(
        ReconstructionError, match="was stopped after --max-runtime-minutes .*; allow more time"
    ):
        run(tmp_path / "database.db", tmp_path / "sparse", max_runtime_minutes=1 / 60)


def test_options_that_the_global_mapper_does_not_heed_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    synthesize(tmp_path / "database.db")
    run(
        tmp_path / "database.db",
        tmp_path / "sparse",
        mapper=Mapper.GLOBAL,
        snapshot_every=4,
        max_runtime_minutes=0.5,
    )
    assert caplog.messages == [
        "--max-runtime-minutes 0.5 has no effect with --mapper global",
        "--snapshot-every 4 has no effect with --mapper global",
    ]


@pytest.mark.parametrize("sizes", [(4, 7), (7, 4)])
def test_largest_model_comes_first(tmp_path: Path, sizes: tuple[int, int]) -> None:
    two_worlds(tmp_path / "database.db", sizes)
    summaries = run(tmp_path / "database.db", tmp_path / "sparse")
    assert [summary.num_images for summary in summaries] == [7, 4]
    assert [model.num_reg_images() for model in read_models(tmp_path / "sparse")] == [7, 4]


def test_models_below_the_smallest_size_are_dropped(tmp_path: Path) -> None:
    two_worlds(tmp_path / "database.db", (7, 4))
    assert [s.num_images for s in run(tmp_path / "database.db", tmp_path / "sparse", min_model_size=5)] == [7]
    only_one = run(tmp_path / "database.db", tmp_path / "sparse", multiple_models=False)
    assert len(only_one) == 1


def test_few_verified_matches_are_enough_once_verified(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db", num_images=12, num_points=400)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        for image_id in range(1, 12):
            geometry = database.read_two_view_geometry(image_id, 12)
            geometry.inlier_matches = geometry.inlier_matches[12 * image_id : 12 * image_id + 12]
            database.update_two_view_geometry(image_id, 12, geometry)
    (summary,) = run(tmp_path / "database.db", tmp_path / "sparse")
    assert summary.num_images == 12


def test_only_large_scenes_are_mapped_on_many_threads() -> None:
    assert [threads_for(num, 8) for num in (2, 200, 201)] == [1, 1, 8]
    assert threads_for(1000, 0) == 0


@pytest.mark.parametrize("mapper", list(Mapper))
def test_same_seed_gives_the_same_bytes_on_any_number_of_threads(tmp_path: Path, mapper: Mapper) -> None:
    synthesize(tmp_path / "database.db", num_points=300, inlier_match_ratio=0.7)
    for threads in (1, 2, 8):
        run(tmp_path / "database.db", tmp_path / str(threads), seed=3, num_threads=threads, mapper=mapper)
    for file in MODEL_FILES:
        models = {(tmp_path / str(threads) / "0" / file).read_bytes() for threads in (1, 2, 8)}
        assert len(models) == 1, file


def test_progress_counts_registered_photos(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db")
    counts: list[int] = []
    run(tmp_path / "database.db", tmp_path / "sparse", on_progress=counts.append)
    assert counts == list(range(2, 11))


def test_cancelled_mapping_keeps_the_old_models(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db")
    run(tmp_path / "database.db", tmp_path / "sparse")
    before = (tmp_path / "sparse/0/points3D.bin").read_bytes()

    def cancel(num_registered: int) -> None:
        if num_registered == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "database.db", tmp_path / "sparse", on_progress=cancel, seed=1)
    assert (tmp_path / "sparse/0/points3D.bin").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db", "sparse"]


def test_killed_mapping_leaves_no_models_and_the_next_run_succeeds(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db")
    code = f"""
import os
from pathlib import Path
from corrsfm.config import ReconstructionConfig
from corrsfm.reconstruction.mapper import _ranked, threads_for, reconstruct
folder = Path({str(tmp_path)!r})
reconstruct(folder / "database.db", None, folder / "sparse", config=ReconstructionConfig(),
            on_progress=lambda num: os._exit(9) if num == 6 else None)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 9
    assert not (tmp_path / "sparse").exists()
    assert run(tmp_path / "database.db", tmp_path / "sparse")[0].num_images == 10
    assert sorted(path.name for path in tmp_path.iterdir()) == ["database.db", "sparse"]


DEAF_MAPPER = """
import sys, time
from pathlib import Path
import cv2, pycolmap
from corrsfm.config import Mapper, ReconstructionConfig
from corrsfm.reconstruction.mapper import reconstruct

def deaf(*arguments):
    print("mapping", flush=True)
    end = time.monotonic() + 40
    while time.monotonic() < end:
        try:
            time.sleep(0.1)
        except KeyboardInterrupt:
            pass

pycolmap.global_mapping = deaf
folder = Path(sys.argv[1])
config = ReconstructionConfig(mapper=Mapper.GLOBAL)
try:
    reconstruct(folder / "database.db", None, folder / "sparse", config=config)
except KeyboardInterrupt:
    sys.exit(130)
"""


def test_interrupt_stops_a_mapper_that_does_not_look_for_it(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db", 5, 50)
    process = subprocess.Popen(
        [sys.executable, "-c", DEAF_MAPPER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "mapping\n"
    started = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert time.monotonic() - started < 20
    process.stdout.close()
    assert [path.name for path in tmp_path.iterdir()] == ["database.db"]


def test_points_take_their_colours_from_the_photos(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "database.db", 5, 50)
    photos = tmp_path / "images"
    photos.mkdir()
    orange = np.full((768, 1024, 3), (0, 128, 255), np.uint8)
    for image in truth.images.values():
        cv2.imwrite(str(photos / image.name), orange)
    for mapper in (Mapper.INCREMENTAL, Mapper.GLOBAL):
        run(tmp_path / "database.db", tmp_path / "sparse", photos, mapper=mapper)
        (model,) = read_models(tmp_path / "sparse")
        assert {tuple(point.color.tolist()) for point in model.points3D.values()} == {(255, 128, 0)}


def test_missing_photos_do_not_stop_the_mapping(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db", 5, 50)
    (tmp_path / "images").mkdir()
    for mapper in Mapper:
        (summary,) = run(tmp_path / "database.db", tmp_path / "sparse", tmp_path / "images", mapper=mapper)
        assert summary.num_images == 5


def test_snapshots_are_written_beside_the_models(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db")
    run(tmp_path / "database.db", tmp_path / "sparse", snapshot_every=4)
    snapshots = sorted((tmp_path / "snapshots").iterdir())
    assert snapshots
    assert 0 < pycolmap.Reconstruction(snapshots[0]).num_reg_images() <= 10


def test_database_is_not_changed(tmp_path: Path) -> None:
    synthesize(tmp_path / "database.db")

    def content() -> list:
        with pycolmap.Database.open(tmp_path / "database.db") as database:
            ids, geometries = database.read_two_view_geometries()
            cameras = [camera.params.tolist() for camera in database.read_all_cameras()]
            return [ids, [geometry.inlier_matches.tolist() for geometry in geometries], cameras]

    before = content()
    for mapper in Mapper:
        run(tmp_path / "database.db", tmp_path / "sparse", mapper=mapper)
        assert content() == before


def no_photos(database: pycolmap.Database) -> None:
    database.clear_all_tables()


def no_pairs(database: pycolmap.Database) -> None:
    database.clear_matches()
    database.clear_two_view_geometries()


def all_pruned(database: pycolmap.Database) -> None:
    pairs = [pycolmap.pair_id_to_image_pair(pair) for pair in database.read_num_matches()[0]]
    no_pairs(database)
    for pair in pairs:
        database.write_matches(*pair, np.zeros((0, 2), np.uint32))


def none_verified(database: pycolmap.Database) -> None:
    database.clear_two_view_geometries()


def no_baseline(database: pycolmap.Database) -> None:
    for pair in database.read_two_view_geometries()[0]:
        id0, id1 = pycolmap.pair_id_to_image_pair(pair)
        geometry = database.read_two_view_geometry(id0, id1)
        geometry.inlier_matches = geometry.inlier_matches[: 8 + (id0 == 1 and id1 == 2)]
        database.update_two_view_geometry(id0, id1, geometry)


@pytest.mark.parametrize(
    ("prepare", "mapper", "message"),
    [
        (no_photos, Mapper.INCREMENTAL, "at least 2 photos are needed, the number of photos is 0"),
        (no_pairs, Mapper.INCREMENTAL, "no pair of photos was matched"),
        (all_pruned, Mapper.GLOBAL, "all 10 pairs were pruned to nothing"),
        (none_verified, Mapper.HIERARCHICAL, "none of the 10 pairs passed .* with 50 matches;"),
        (
            no_baseline,
            Mapper.INCREMENTAL,
            r"10 of 10 pairs are verified, the best is \w+000.png – \w+001.png with 9 matches, but",
        ),
    ],
)
def test_no_model_is_an_error_with_the_reason(tmp_path: Path, prepare, mapper: Mapper, message: str) -> None:
    synthesize(tmp_path / "database.db", 5, 50)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        prepare(database)
    with pytest.raises(ReconstructionError, match=message):
        run(tmp_path / "database.db", tmp_path / "sparse", mapper=mapper)
    assert [path.name for path in tmp_path.iterdir()] == ["database.db"]


def test_missing_database_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatabaseError, match=r"nothing\.db: no such database"):
        run(tmp_path / "nothing.db", tmp_path / "sparse")
    assert os.listdir(tmp_path) == []


def test_folder_without_models_is_named(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="holds no model"):
        read_models(tmp_path)
    (tmp_path / "0").mkdir()
    with pytest.raises(WorkspaceError, match="no readable COLMAP model"):
        read_models(tmp_path)


def test_observation_errors_are_distances_in_pixels(tmp_path: Path) -> None:
    model = synthesize(tmp_path / "database.db", 3, 40)
    assert observation_errors(model).shape == (120,)
    np.testing.assert_allclose(observation_errors(model), 0, atol=1e-6)
    moved = min(model.images.values(), key=lambda image: image.name)
    for index in moved.get_observation_point2D_idxs()[:2]:
        moved.points2D[index].xy = moved.points2D[index].xy + [3.0, 4.0]
    errors = observation_errors(model)
    np.testing.assert_allclose(errors[:3], [5, 5, 0], atol=1e-6)
    summary = summarise_model(model)
    assert summary.mean_error_px == pytest.approx(10 / 120, abs=1e-6)
    assert summary.median_error_px == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("mapper", [Mapper.INCREMENTAL, Mapper.GLOBAL])
def test_known_intrinsics_can_be_kept(tmp_path: Path, mapper: Mapper) -> None:
    synthesize(tmp_path / "database.db", camera_has_prior_focal_length=True)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        (camera,) = database.read_all_cameras()
        camera.params[0] *= 1.01
        database.update_camera(camera)
    given = list(camera.params)
    for refine in (True, False):
        run(tmp_path / "database.db", tmp_path / "models", mapper=mapper, refine_intrinsics=refine)
        (model,) = read_models(tmp_path / "models")
        (found,) = model.cameras.values()
        assert (list(found.params) == given) is not refine


def test_a_model_inside_a_larger_one_is_not_kept(tmp_path: Path) -> None:
    whole = synthesize(tmp_path / "database.db", num_images=6)
    part = pycolmap.Reconstruction(whole)
    for frame_id in list(part.reg_frame_ids())[:2]:
        part.deregister_frame(frame_id)
    assert part.num_reg_images() == 4
    assert [model.num_reg_images() for model in _ranked([part, whole], 3)] == [6]
