"""The COLMAP database."""

import dataclasses
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from database_scene import (
    CAMERA,
    NAMES,
    NUM_POINTS,
    all_matches,
    images,
    kept_pairs,
    scene_features,
    write,
)

from corrsfm.colmap.log import colmap_log
from corrsfm.colmap.pairs import read_verified_pairs
from corrsfm.colmap.sqlite import database_errors
from corrsfm.config import DatabaseConfig
from corrsfm.database.verification import default_verification_error_px
from corrsfm.database.write import write_database
from corrsfm.errors import DatabaseError, InputError
from corrsfm.types import Camera, Features, ImageRecord, VerifiedPair

SUPPORT = Path(__file__).resolve().parents[1] / "support"


def counts(path: Path) -> dict[str, int]:
    with pycolmap.Database.open(path) as database:
        # A pair whose verification failed has a row without inliers.
        _, num_inliers = database.read_two_view_geometry_num_inliers()
        _, num_matches = database.read_num_matches()
        return {
            "images": database.num_images(),
            "keypoints": database.num_keypoints(),
            "pairs": database.num_matched_image_pairs(),
            "empty pairs": database.num_matched_image_pairs() - sum(num > 0 for num in num_matches),
            "matches": database.num_matches(),
            "verified pairs": sum(num > 0 for num in num_inliers),
            "inliers": sum(num_inliers),
        }


def configurations(path: Path) -> list[str]:
    with pycolmap.Database.open(path) as database:
        geometries = [database.read_two_view_geometry(*pair) for pair in ((1, 2), (2, 3))]
    return [pycolmap.TwoViewGeometryConfiguration(geometry.config).name for geometry in geometries]


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_database_holds_exactly_what_was_written(tmp_path: Path) -> None:
    write(tmp_path / "database.db")
    assert counts(tmp_path / "database.db") == {
        "images": 3,
        "keypoints": 180,
        "pairs": 3,
        "empty pairs": 1,
        "matches": 80,
        "verified pairs": 2,
        "inliers": 80,
    }
    assert files(tmp_path) == ["database.db"]
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        written = database.read_all_images()
        assert [image.name for image in written] == sorted(NAMES)
        assert [image.frame_id for image in written] == [1, 2, 3]
        (camera,) = database.read_all_cameras()
        assert camera.model_name == "SIMPLE_RADIAL"
        assert camera.params.tolist() == list(CAMERA.params)
        assert camera.has_prior_focal_length
        (rig,) = database.read_all_rigs()
        assert rig.is_ref_sensor(camera.sensor_id)
        assert [frame.rig_id for frame in database.read_all_frames()] == [rig.rig_id] * 3
        keypoints = database.read_keypoints(written[0].image_id)
        np.testing.assert_array_equal(keypoints[:, :2], scene_features()[written[0].name].keypoints)
        assert database.num_descriptors() == 0
        assert database.num_pose_priors() == 0


def test_pairs_are_read_back_by_name_and_the_empty_one_on_request(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    write(path)
    expected = [
        VerifiedPair(name0=NAMES[0], name1=NAMES[1], num_matches=60, num_inliers=60),
        VerifiedPair(name0=NAMES[1], name1=NAMES[2], num_matches=20, num_inliers=20),
    ]
    empty = VerifiedPair(name0=NAMES[0], name1=NAMES[2], num_matches=0, num_inliers=0)
    assert configurations(path) == ["CALIBRATED", "CALIBRATED"]
    assert read_verified_pairs(path) == expected
    assert read_verified_pairs(path, [(NAMES[2], NAMES[0]), ("no", "such")]) == [
        expected[0],
        empty,
        expected[1],
    ]


def test_cameras_without_prior_focal_length_are_verified_uncalibrated(tmp_path: Path) -> None:
    guessed = Camera(model=CAMERA.model, width=640, height=480, params=CAMERA.params)
    write(tmp_path / "database.db", cameras=[guessed])
    assert configurations(tmp_path / "database.db") == ["UNCALIBRATED", "UNCALIBRATED"]


def test_wrong_matches_are_not_verified(tmp_path: Path) -> None:
    wrong = np.column_stack([np.arange(30, 60), np.random.default_rng(1).permutation(30)]).astype(np.int32)
    write(
        tmp_path / "database.db",
        [(NAMES[0], NAMES[1], np.vstack([all_matches()[:30], wrong])), (NAMES[0], NAMES[2], wrong)],
    )
    found = counts(tmp_path / "database.db")
    assert (found["verified pairs"], found["matches"]) == (1, 90)
    assert 30 <= found["inliers"] <= 36


def test_fewest_inliers_decide_which_pairs_are_verified(tmp_path: Path) -> None:
    write(tmp_path / "database.db", config=DatabaseConfig(min_num_inliers=21))
    assert counts(tmp_path / "database.db")["verified pairs"] == 1
    write(tmp_path / "database.db", config=DatabaseConfig(min_num_inliers=20))
    assert [pair.num_inliers for pair in read_verified_pairs(tmp_path / "database.db")] == [60, 20]


def test_verification_is_the_same_with_any_number_of_threads(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    noisy = np.column_stack(
        [np.arange(60), np.where(rng.random(60) < 0.5, np.arange(60), rng.permutation(60))]
    )
    geometries = []
    for num_threads in (1, 2, 0):
        path = tmp_path / f"{num_threads}.db"
        write(path, [(NAMES[0], NAMES[1], noisy.astype(np.int32))], seed=7, num_threads=num_threads)
        with pycolmap.Database.open(path) as database:
            geometries.append(database.read_two_view_geometry(1, 2))
    for geometry in geometries[1:]:
        np.testing.assert_array_equal(geometry.E, geometries[0].E)
        np.testing.assert_array_equal(geometry.inlier_matches, geometries[0].inlier_matches)


def test_repeated_matches_are_written_once_in_order(tmp_path: Path) -> None:
    indices = np.array([[5, 5], [3, 3], [5, 5], [3, 4]], np.int32)
    write(tmp_path / "database.db", [(NAMES[0], NAMES[1], indices)])
    assert counts(tmp_path / "database.db")["matches"] == len(indices) - 1
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        assert database.read_matches(1, 2).tolist() == [[5, 5], [3, 3], [3, 4]]


def test_descriptors_are_written_on_request(tmp_path: Path) -> None:
    write(tmp_path / "database.db", config=DatabaseConfig(write_descriptors=True))
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        descriptors = database.read_descriptors(2)
        assert descriptors.type == pycolmap.FeatureExtractorType.SIFT
        np.testing.assert_array_equal(descriptors.data, scene_features()[NAMES[1]].descriptors)


def test_gps_becomes_a_pose_prior_of_its_image(tmp_path: Path) -> None:
    records = images()[:2] + [
        ImageRecord(name=NAMES[2], camera_id=0, sha256="", gps=(48.5, 9.25, 410.0)),
    ]
    write(tmp_path / "database.db", images=records)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        (prior,) = database.read_all_pose_priors()
        assert prior.position.tolist() == [48.5, 9.25, 410.0]
        assert prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.WGS84
        assert database.read_image(prior.corr_data_id.id).name == NAMES[2]


def test_image_without_keypoints_is_kept(tmp_path: Path) -> None:
    empty = Features(
        keypoints=np.zeros((0, 2), np.float32),
        scales=np.zeros(0, np.float32),
        orientations=np.zeros(0, np.float32),
        scores=np.zeros(0, np.float32),
        descriptors=np.zeros((0, 128), np.uint8),
        image_size=(640, 480),
    )
    features = scene_features() | {NAMES[2]: empty}
    pruned = [(NAMES[0], NAMES[1], all_matches()), (NAMES[0], NAMES[2], np.zeros((0, 2), np.int32))]
    write(tmp_path / "database.db", pruned, features=features.__getitem__)
    found = counts(tmp_path / "database.db")
    assert (found["images"], found["keypoints"], found["empty pairs"]) == (3, 120, 1)


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        ((NAMES[0], "c.jpg", np.zeros((0, 2), np.int32)), "c.jpg is not among the photos"),
        ((NAMES[0], NAMES[0], np.zeros((0, 2), np.int32)), "paired with itself"),
        ((NAMES[0], NAMES[1], np.array([[0, 60]], np.int32)), "keypoint 60 of a/1.jpg, which has 60"),
        ((NAMES[0], NAMES[1], np.array([[-1, 0]], np.int32)), "keypoint -1 of a b/größe.jpg"),
        ((NAMES[0], NAMES[1], np.zeros((3, 2), np.float32)), "expected integers"),
        ((NAMES[1], NAMES[2], np.zeros((0, 2), np.int32)), "pair a/1.jpg – b.jpg: occurs twice"),
    ],
)
def test_bad_pair_is_named_and_leaves_the_old_database(tmp_path: Path, pair, message: str) -> None:
    path = tmp_path / "database.db"
    write(path)
    before = path.read_bytes()
    with pytest.raises(InputError, match=message):
        write(path, [(NAMES[2], NAMES[1], all_matches()), pair])
    assert path.read_bytes() == before
    assert files(tmp_path) == ["database.db"]


def test_failure_midway_leaves_nothing(tmp_path: Path) -> None:
    def failing():
        yield kept_pairs()[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "database.db", failing())
    assert files(tmp_path) == []


def test_killed_run_leaves_no_database_and_the_next_run_succeeds(tmp_path: Path) -> None:
    code = f"""
import os, sys
sys.path.insert(0, {str(SUPPORT)!r})
import database_scene as t
from pathlib import Path
def killed():
    yield t.kept_pairs()[0]
    os._exit(9)
t.write(Path({str(tmp_path)!r}) / "database.db", killed())
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 9
    assert not (tmp_path / "database.db").exists()
    assert files(tmp_path), "the killed run should have left its unfinished file"
    write(tmp_path / "database.db")
    assert counts(tmp_path / "database.db")["pairs"] == 3
    assert files(tmp_path) == ["database.db"]


HOLD = """
import sys, time, sqlite3
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute(sys.argv[2])
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def hold():
    processes = []

    def start(path: Path, statement: str) -> None:
        process = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(path), statement], stdout=subprocess.PIPE, text=True
        )
        processes.append(process)
        assert process.stdout.readline() == "held\n"

    yield start
    for process in processes:
        process.kill()
        process.wait()
        process.stdout.close()


def test_database_locked_by_another_process_is_said_to_be_in_use(tmp_path: Path, hold) -> None:
    path = tmp_path / "database.db"
    write(path)
    hold(path, "BEGIN EXCLUSIVE")
    started = time.monotonic()
    with pytest.raises(DatabaseError, match=r"database\.db: is in use by another program"):
        write(path)
    assert time.monotonic() - started < 30
    assert len(read_verified_pairs(path)) == 2


@pytest.mark.parametrize("suffix", ["-wal", "-shm", "-journal"])
def test_a_log_whose_database_is_gone_is_in_nobodys_way(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / "database.db"
    log = tmp_path / f"database.db{suffix}"
    log.touch()
    write(path)
    assert len(read_verified_pairs(path)) == 2 and not log.exists()


def test_database_open_in_another_process_is_not_replaced(tmp_path: Path, hold) -> None:
    path = tmp_path / "database.db"
    write(path)
    before = path.read_bytes()
    hold(path, "SELECT * FROM cameras")
    with pytest.raises(DatabaseError, match="in use"):
        write(path)
    assert path.read_bytes() == before


FULL_DISK = """
import resource, sys
sys.path.insert(0, sys.argv[1])
import database_scene as t
from corrsfm.errors import DatabaseError
from pathlib import Path
path = Path(sys.argv[2])
# A limit on the size of files fails like a disk that fills up.
resource.setrlimit(resource.RLIMIT_FSIZE, (250_000, 250_000))
try:
    features = t.big_features().__getitem__
    t.write(path, features=features)
except DatabaseError as error:
    print(error)
"""


def test_disk_that_fills_up_is_said_and_leaves_the_old_database(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    write(path)
    before = path.read_bytes()
    arguments = [sys.executable, "-c", FULL_DISK, str(SUPPORT), str(path)]
    output = subprocess.run(arguments, check=True, capture_output=True, text=True).stdout
    assert output == f"{path}: the disk is full or failing; free some space and run the same command again\n"
    assert path.read_bytes() == before
    assert files(tmp_path) == ["database.db"]


@pytest.mark.parametrize(
    ("message", "told"),
    [
        ("[database_sqlite.cc:1350] SQLite error: database or disk is full", "the disk is full"),
        ("[database_sqlite.cc:1350] SQLite error: database is locked", "in use by another program"),
        ("SQLite error: attempt to write a readonly database", "check the permissions"),
        ("SQLite error: constraint failed", "constraint failed; delete the file"),
    ],
)
def test_failures_of_the_database_are_translated(tmp_path: Path, message: str, told: str) -> None:
    with pytest.raises(DatabaseError, match=told), database_errors(tmp_path / "database.db"):
        raise RuntimeError(message)


def test_other_failures_are_not_blamed_on_the_database(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="bundle"), database_errors(tmp_path / "database.db"):
        raise RuntimeError("bundle adjustment went wrong")


def test_file_that_is_no_database_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    path.write_text("holiday pictures")
    with pytest.raises(DatabaseError, match="is not a COLMAP database"):
        write(path)
    assert path.read_text() == "holiday pictures"


def test_missing_database_is_an_error_that_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(DatabaseError, match="corrsfm prune"):
        read_verified_pairs(tmp_path / "database.db")
    assert files(tmp_path) == []


def test_log_goes_to_the_file_and_not_to_the_terminal(tmp_path: Path, capfd) -> None:
    write(tmp_path / "database.db", log_file=tmp_path / "log.txt")
    write(tmp_path / "database.db")
    assert capfd.readouterr() == ("", "")
    assert "geometric" in (tmp_path / "log.txt").read_text().lower()


@pytest.mark.parametrize(("longest", "expected"), [(320, 2.0), (1000, 2.0), (1500, 3.0), (6000, 4.0)])
def test_verification_is_stricter_with_small_photos(longest: int, expected: float) -> None:
    cameras = [dataclasses.replace(CAMERA, height=size) for size in (300, longest, longest)]
    cameras = [dataclasses.replace(camera, width=200) for camera in cameras]
    assert default_verification_error_px(cameras) == pytest.approx(expected)


def test_log_settings_of_the_process_come_back(tmp_path: Path) -> None:
    before = (pycolmap.logging.minloglevel, pycolmap.logging.alsologtostderr)
    with pytest.raises(ZeroDivisionError), colmap_log(tmp_path / "log.txt"):
        pycolmap.logging.warning("watch out")
        raise ZeroDivisionError
    assert (pycolmap.logging.minloglevel, pycolmap.logging.alsologtostderr) == before
    assert "watch out" in (tmp_path / "log.txt").read_text()


def test_features_without_shape_and_with_floats_are_written_as_they_are(tmp_path: Path) -> None:
    features = {
        name: dataclasses.replace(
            one,
            scales=None,
            orientations=None,
            descriptors=np.linspace(-1, 1, NUM_POINTS * 256, dtype=np.float32).reshape(NUM_POINTS, 256),
        )
        for name, one in scene_features().items()
    }
    path = tmp_path / "database.db"
    write_database(
        path, images=images(), cameras=[CAMERA], features=features.__getitem__, kept=[],
        config=DatabaseConfig(write_descriptors=True),
    )  # fmt: skip
    with pycolmap.Database.open(path) as database:
        (image,) = [one for one in database.read_all_images() if one.name == NAMES[2]]
        assert database.read_keypoints(image.image_id).shape[1] == 2
        stored = database.read_descriptors(image.image_id)
        assert stored.type == pycolmap.FeatureExtractorType.UNDEFINED
        found = np.ascontiguousarray(stored.data).view(np.float32)
    np.testing.assert_array_equal(found, features[NAMES[2]].descriptors)
