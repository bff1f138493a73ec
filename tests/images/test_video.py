"""Frames of a video: sharp ones where the camera moves, whole files only, and resumed."""

import json
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray
from phone_video import Film, film

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.cli import main
from corrsfm.errors import ConfigError, InputError, WorkspaceError
from corrsfm.finished.check import _photos
from corrsfm.images.frames import extract_frames
from corrsfm.images.video import Measured, choose_frames, measure_video, read_frames, seconds_of
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import read_index, read_pairs

RUN = cfg.RunConfig(threads=1, device="cpu")
SIZE = (320, 240)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Film:
    """Ten frames standing, thirty walking, of which two of three are blurred."""
    return film(tmp_path_factory.mktemp("film") / "walk.mp4", 10, 30, size=SIZE)


def write_video(path: Path, frames: Iterable[NDArray[np.uint8]], fourcc: str = "MJPG") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), 10.0, SIZE)
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def sliding(num: int) -> Iterator[NDArray[np.uint8]]:
    """A texture that slides by a twentieth of the width a frame."""
    noise = np.random.default_rng(0).uniform(0, 255, (SIZE[1], SIZE[0] + 16 * num, 3))
    texture = cv2.GaussianBlur(noise, (0, 0), 2.0)
    texture = cv2.normalize(texture, texture, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    for number in range(num):
        yield np.ascontiguousarray(texture[:, 16 * number : 16 * number + SIZE[0]])


def measured(sharpness: list[float], path: list[float], rate: float = 10.0) -> Measured:
    return Measured(
        width=1, height=1, times_s=np.arange(len(path)) / rate, sharpness=np.array(sharpness),
        path=np.array(path), num_announced=len(path),
    )  # fmt: skip


def test_blurred_frames_are_avoided_and_a_camera_that_stands_gives_one_frame(
    walk: Film, tmp_path: Path
) -> None:
    numbers = [frame.number for frame in extract_frames(walk.path, tmp_path / "frames")]
    assert len(numbers) >= 8
    assert len(walk.blurred) == 20 and not walk.blurred & set(numbers)
    assert len(walk.standing & set(numbers)) == 1
    assert max(np.diff(numbers)) <= 6


@pytest.mark.parametrize("options", [{"num_frames": 6}, {"every": "0.4s"}])
def test_frames_are_chosen_by_number_or_by_time(walk: Film, tmp_path: Path, options: dict) -> None:
    frames = extract_frames(walk.path, tmp_path / "frames", **options)
    numbers = {frame.number for frame in frames}
    assert 5 <= len(frames) <= 7
    assert not walk.blurred & numbers and len(walk.standing & numbers) <= 1


def test_the_sharpest_of_each_stretch_is_chosen() -> None:
    video = measured([1, 3, 2, 2, 9, 1, 1, 1, 4], [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
    np.testing.assert_array_equal(choose_frames(video, num_frames=3), [1, 4, 8])
    np.testing.assert_array_equal(choose_frames(video, every_s=0.3), [1, 4, 8])


def test_without_options_motion_says_how_many() -> None:
    path = np.linspace(0, 1, 500).tolist()
    assert len(choose_frames(measured([1.0] * 500, path))) == 40
    far = np.linspace(0, 100, 500).tolist()
    assert len(choose_frames(measured([1.0] * 500, far))) == 300


def test_a_stretch_that_is_blurred_all_through_is_left_out() -> None:
    sharpness = [10.0] * 10 + [1.0] * 3 + [10.0] * 10
    chosen = choose_frames(measured(sharpness, np.linspace(0, 1, 23).tolist()), num_frames=23)
    assert set(chosen) == set(range(23)) - {10, 11, 12}


def test_trembling_hands_do_not_count_as_motion(tmp_path: Path) -> None:
    frame = next(iter(sliding(3)))
    rng = np.random.default_rng(1)
    shaken = (np.roll(frame, tuple(rng.integers(-1, 2, 2)), (0, 1)) for _ in range(40))
    assert measure_video(write_video(tmp_path / "a.avi", shaken)).path[-1] < 0.02


def test_a_frame_is_read_whole_and_its_time_is_kept(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.avi", sliding(20))
    frames = extract_frames(path, tmp_path / "frames", num_frames=5)
    kept = json.loads((tmp_path / "frames" / "frames.json").read_text())["frames"]
    assert [frame.time_s for frame in frames] == pytest.approx([frame.number / 10 for frame in frames])
    assert [(k["name"], k["time_s"]) for k in kept] == [(frame.name, frame.time_s) for frame in frames]
    originals = dict(read_frames(path, [frame.number for frame in frames]))
    for frame in frames:
        written = cv2.imread(str(tmp_path / "frames" / frame.name), cv2.IMREAD_GRAYSCALE).astype(int)
        original = cv2.cvtColor(originals[frame.number], cv2.COLOR_BGR2GRAY)
        assert np.abs(written - original).mean() < 2


@pytest.mark.parametrize(("text", "seconds"), [("0.5s", 0.5), ("500ms", 0.5), ("2", 2.0), (" 1 S", 1.0)])
def test_durations(text: str, seconds: float) -> None:
    assert seconds_of(text) == pytest.approx(seconds)


@pytest.mark.parametrize("content", ["ffconcat version 1.0\nfile other.mp4\n", "#EXTM3U\n", "v=0\n"])
def test_a_list_of_other_files_is_no_video(tmp_path: Path, content: str) -> None:
    (tmp_path / "video.mp4").write_text(content)
    with pytest.raises(InputError, match=r"video\.mp4: is a list of other files"):
        extract_frames(tmp_path / "video.mp4", tmp_path / "frames")


@pytest.mark.parametrize("text", ["", "s", "fast", "0", "-1s", "nan", "inf", "1e-300s", "0.9ms"])
def test_what_is_no_duration_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expected a time from 1ms on, such as 0.5s"):
        seconds_of(text)


def test_an_interrupted_extraction_leaves_whole_frames_and_goes_on(tmp_path: Path) -> None:
    path, folder = write_video(tmp_path / "a.avi", sliding(20)), tmp_path / "frames"

    def interrupt(items: Iterable, total: int, text: str) -> Iterator:
        for number, item in enumerate(items):
            if text == "writing frames" and number == 3:
                raise KeyboardInterrupt
            yield item

    with pytest.raises(KeyboardInterrupt):
        extract_frames(path, folder, num_frames=6, track=interrupt)
    written = sorted(folder.glob("frame_*"))
    assert len(written) == 3 and not list(folder.glob("*.partial")) and not list(folder.glob(".frame*"))
    assert not (folder / "frames.json").exists()
    stamps = [file.stat().st_mtime_ns for file in written]
    measured_at = (folder / ".corrsfm.json").stat().st_mtime_ns
    assert len(extract_frames(path, folder, num_frames=6)) == 6
    assert stamps == [file.stat().st_mtime_ns for file in written]
    assert measured_at == (folder / ".corrsfm.json").stat().st_mtime_ns


def test_a_frame_that_changed_is_taken_from_the_video_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, folder = write_video(tmp_path / "a.avi", sliding(20)), tmp_path / "frames"
    frames = extract_frames(path, folder, num_frames=6)
    before = {frame.name: (folder / frame.name).read_bytes() for frame in frames}
    (folder / frames[1].name).write_bytes(before[frames[2].name])
    (folder / frames[4].name).write_bytes(b"x")
    assert extract_frames(path, folder, num_frames=6) == frames
    assert {frame.name: (folder / frame.name).read_bytes() for frame in frames} == before
    assert f"taken from the video again: {frames[1].name}, {frames[4].name}" in caplog.text
    (folder / "frames.json").write_text("{}")
    assert extract_frames(path, folder, num_frames=6) == frames


def test_a_changed_option_chooses_again_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, folder = write_video(tmp_path / "a.avi", sliding(20)), tmp_path / "frames"
    caplog.set_level("INFO")
    extract_frames(path, folder, num_frames=6)
    before = {file.name for file in folder.glob("frame_*")}
    frames = extract_frames(path, folder, num_frames=9)
    assert {file.name for file in folder.glob("frame_*")} == {frame.name for frame in frames}
    kept = len(before & {frame.name for frame in frames})
    assert f"frames: chosen again (frames 6 → 9): {9 - kept} new, {kept} kept" in caplog.text


def test_another_video_of_the_same_name_gives_its_own_frames(tmp_path: Path) -> None:
    path, folder = write_video(tmp_path / "a.avi", sliding(20)), tmp_path / "frames"
    extract_frames(path, folder, num_frames=20)
    before = {file.name: file.read_bytes() for file in folder.glob("frame_*")}
    write_video(path, (255 - frame for frame in sliding(20)))
    extract_frames(path, folder, num_frames=20)
    after = {file.name: file.read_bytes() for file in folder.glob("frame_*")}
    assert len(before.keys() & after.keys()) > 10
    assert all(before[name] != after[name] for name in before.keys() & after.keys())


def test_a_video_that_was_cut_off_gives_the_frames_before_the_cut(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_video(tmp_path / "a.avi", sliding(40))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    frames = extract_frames(path, tmp_path / "frames")
    assert 5 < len(frames) <= 20
    assert "of 40 frames can be decoded" in caplog.text and "cut off or damaged there" in caplog.text


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, "no such file; expected a video"),
        (b"", "the file is empty"),
        (b"no video at all" * 100, "cannot be opened as a video"),
    ],
)
def test_what_is_no_video_is_refused_by_name(tmp_path: Path, content: bytes | None, text: str) -> None:
    if content is not None:
        (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.mp4: {text}"):
        extract_frames(tmp_path / "a.mp4", tmp_path / "frames")
    assert not (tmp_path / "frames").exists()


def test_a_recording_without_its_index_is_refused(walk: Film, tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(walk.path.read_bytes()[: walk.path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"a\.mp4: cannot be opened as a video; it is damaged, cut off"):
        measure_video(tmp_path / "a.mp4")


def test_a_video_in_which_nothing_moves_is_refused(tmp_path: Path) -> None:
    still = write_video(tmp_path / "a.avi", [next(iter(sliding(3)))] * 20)
    with pytest.raises(InputError, match=r"20 frames can be decoded, .* moves by 0% .*film while you walk"):
        extract_frames(still, tmp_path / "frames")
    with pytest.raises(InputError, match=r"or try less than --every 5s"):
        extract_frames(still, tmp_path / "frames", every="5s")
    with pytest.raises(InputError, match=r"ask for more than --frames 1"):
        extract_frames(still, tmp_path / "frames", num_frames=1)
    black = write_video(tmp_path / "b.avi", [np.zeros((SIZE[1], SIZE[0], 3), np.uint8)] * 5)
    with pytest.raises(InputError, match="fewer than two frames"):
        extract_frames(black, tmp_path / "frames_b")


def test_a_container_without_frames_is_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.avi", sliding(2))
    content = path.read_bytes()
    path.write_bytes(content[: content.index(b"movi") + 4])
    with pytest.raises(InputError, match=r"a\.avi: (holds no frame|cannot be opened)"):
        measure_video(path)


def test_frames_of_others_are_not_touched(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.avi", sliding(5))
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "mine.jpg").write_bytes(b"precious")
    with pytest.raises(WorkspaceError, match="holds files of others.*give that folder itself"):
        extract_frames(path, tmp_path / "frames")
    assert (tmp_path / "frames" / "mine.jpg").read_bytes() == b"precious"


def test_the_rotation_of_a_phone_is_applied(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", sliding(10), "mp4v")
    upright = measure_video(path)
    content = bytearray(path.read_bytes())
    # The matrix of the track header: x and y of the picture as shown, in 16.16 fixed point.
    matrix = content.index(b"tkhd") + 44
    for position, value in enumerate((0, 1, 0, -1, 0, 0, SIZE[1], 0)):
        content[matrix + 4 * position : matrix + 4 * position + 4] = (value << 16).to_bytes(
            4, "big", signed=True
        )
    path.write_bytes(bytes(content))
    turned = measure_video(path)
    assert (upright.width, upright.height) == SIZE
    assert (turned.width, turned.height) == SIZE[::-1]
    _, frame = next(read_frames(path, [0]))
    assert frame.shape == (SIZE[0], SIZE[1], 3)
    corner = next(iter(sliding(10)))[-8:, :8].mean()  # what is at the lower left is shown at the upper left
    assert frame[:8, :8].mean() == pytest.approx(corner, abs=12)


@pytest.fixture(scope="module")
def workspace(walk: Film, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    folder = tmp_path_factory.mktemp("scene") / "scene"
    words = ["extract", str(walk.path), str(folder), "--frames", "14", "--max-features", "200"]
    result = CliRunner().invoke(main, [*words, "--threads", "1", "--device", "cpu"])
    assert result.exit_code == 0, result.output
    return Workspace(folder)


def test_frames_share_a_camera_and_are_paired_in_time_with_loops(workspace: Workspace) -> None:
    index = read_index(workspace)
    assert len(index.cameras) == 1 and len(index.records) >= 10
    assert workspace.images_dir == workspace.frames and workspace.is_sequence
    found = read_pairs(workspace)
    assert {origin for origins in found.origins for origin in origins} == {"loop-closure", "sequential"}
    assert set(zip(index.names, index.names[1:], strict=False)) <= set(found.pairs)


def test_an_explicit_pairing_wins(workspace: Workspace, tmp_path: Path) -> None:
    copied = Workspace(shutil.copytree(workspace.root, tmp_path / "scene"))
    config = cfg.PairsConfig(pairing=(cfg.PairStrategy.EXHAUSTIVE,))
    num = len(read_index(copied).names)
    assert pipeline.make_pairs(copied, config, RUN).num_items == num * (num - 1) // 2


def test_a_workspace_takes_its_frames_with_it(workspace: Workspace, tmp_path: Path) -> None:
    moved = Workspace(shutil.copytree(workspace.root, tmp_path / "moved"))
    assert moved.images_dir == tmp_path / "moved" / "frames"
    assert json.loads(moved.manifest.read_text())["images_dir"] == "frames"


def test_the_same_command_does_nothing_twice(workspace: Workspace, walk: Film) -> None:
    before = {file.name: file.stat().st_mtime_ns for file in workspace.frames.iterdir()}
    pipeline.index_photos(workspace, walk.path, cfg.ImagesConfig(frames=14), RUN)
    assert pipeline.extract_features(workspace, cfg.FeaturesConfig(max_features=200), RUN).skipped
    assert pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN).skipped
    assert before == {file.name: file.stat().st_mtime_ns for file in workspace.frames.iterdir()}
    assert str(walk.path) in workspace.command_for("images") and "--frames 14" in workspace.command_for(
        "images"
    )


def test_a_video_that_was_moved_is_the_same_and_another_one_is_named(
    workspace: Workspace, walk: Film, tmp_path: Path
) -> None:
    copied = Workspace(shutil.copytree(workspace.root, tmp_path / "scene"))
    frames = {path.name: path.stat().st_mtime_ns for path in copied.frames.glob("*.jpg")}
    moved = Path(shutil.copy(walk.path, tmp_path / f"moved{walk.path.suffix}"))
    pipeline.index_photos(copied, moved, cfg.ImagesConfig(frames=14), RUN)
    assert pipeline.extract_features(copied, cfg.FeaturesConfig(max_features=200), RUN).skipped
    assert {path.name: path.stat().st_mtime_ns for path in copied.frames.glob("*.jpg")} == frames
    assert copied.given_photos == (str(moved),)
    other = write_video(tmp_path / "other.avi", sliding(10))
    with pytest.raises(InputError, match=rf"other\.avi: another video than {moved}, .* --overwrite"):
        pipeline.index_photos(copied, other, cfg.ImagesConfig(frames=4), RUN)


def test_what_becomes_of_lost_frames_is_said_as_it_is(
    workspace: Workspace, walk: Film, tmp_path: Path
) -> None:
    copied = Workspace(shutil.copytree(workspace.root, tmp_path / "scene"))
    (copied.frames / read_index(copied).names[0]).unlink()
    moved = Path(shutil.copy(walk.path, tmp_path / f"moved{walk.path.suffix}"))

    def advice() -> str:
        (finding,) = _photos(copied)
        return finding.next_step

    assert advice().startswith(f"put them back, or make them again, with: corrsfm extract {walk.path} ")
    copied.remember_photos([str(moved)], copied.frames)
    moved.unlink()
    assert "make them again, with: corrsfm extract VIDEO " in advice()
    # Made again from the video, the scene would lose what was added to it.
    copied.added.write_text('{"photos": {"new.jpg": {"model": 0}}}')
    assert f"leave them out, with: corrsfm extract {copied.frames} " in advice()


def test_overwrite_makes_frames_again(workspace: Workspace, walk: Film, tmp_path: Path) -> None:
    copied = Workspace(shutil.copytree(workspace.root, tmp_path / "scene"))
    damaged = copied.frames / read_index(copied).names[0]
    whole = damaged.read_bytes()
    damaged.write_bytes(b"damaged")
    pipeline.index_photos(copied, walk.path, cfg.ImagesConfig(frames=14), RUN, overwrite=True)
    assert damaged.read_bytes() == whole


def test_frames_of_a_workspace_that_lost_its_record_are_kept(
    workspace: Workspace, walk: Film, tmp_path: Path
) -> None:
    copied = Workspace(shutil.copytree(workspace.root, tmp_path / "scene"))
    before = {path.name: path.stat().st_mtime_ns for path in copied.frames.iterdir()}
    copied.manifest.unlink()
    again = Workspace(copied.root, create=True)
    pipeline.index_photos(again, walk.path, cfg.ImagesConfig(frames=14), RUN)
    assert {path.name: path.stat().st_mtime_ns for path in again.frames.iterdir()} == before


def test_a_damaged_frame_is_mended_by_one_run(workspace: Workspace, walk: Film, tmp_path: Path) -> None:
    copied = Workspace(shutil.copytree(workspace.root, tmp_path / "scene"))
    (copied.frames / read_index(copied).names[0]).write_bytes(b"damaged")
    pipeline.index_photos(copied, walk.path, cfg.ImagesConfig(frames=14), RUN)
    assert pipeline.extract_features(copied, cfg.FeaturesConfig(max_features=200), RUN).skipped


def test_two_ways_to_choose_frames_exclude_each_other(walk: Film, tmp_path: Path) -> None:
    words = ["extract", str(walk.path), str(tmp_path / "scene"), "--frames", "5", "--every", "1s"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 1 and "exclude each other" in result.output


def test_a_video_in_a_folder_of_photos_is_pointed_to(tmp_path: Path) -> None:
    write_video(tmp_path / "photos.avi", sliding(2))
    result = CliRunner().invoke(main, ["extract", str(tmp_path), str(tmp_path / "scene")])
    assert result.exit_code == 1
    assert f"to use a video give it in place of its folder: {tmp_path / 'photos.avi'}" in result.output


def test_a_check_of_a_video_says_how(walk: Film) -> None:
    result = CliRunner().invoke(main, ["check", str(walk.path)])
    assert result.exit_code == 1 and "then corrsfm check WORKSPACE/frames" in result.output
