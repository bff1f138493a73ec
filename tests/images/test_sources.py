"""Photos may be named as folders, files, lists and patterns; names stay unique, and nonsense is refused."""

import os
from pathlib import Path

import pytest
from click.testing import CliRunner
from photos import write_photo

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.cli import main
from corrsfm.errors import InputError
from corrsfm.images.sources import find_source, whole_folder
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import read_index

RUN = cfg.RunConfig(threads=1, device="cpu")


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    """Photos of two cameras in two folders, under the same names, beside a third folder."""
    for number, name in enumerate(("left/1.png", "left/2.png", "right/1.png", "other/deep/3.png")):
        write_photo(tmp_path / "walk" / name, 40 * number)
    (tmp_path / "walk" / "notes.txt").write_text("left/1.png\n\n# the best\nright/1.png\n")
    (tmp_path / "walk" / "data.csv").write_text("")
    return tmp_path / "walk"


def test_one_folder_is_taken_whole(walk: Path) -> None:
    source = find_source(walk)
    assert (source.folder, source.names, source.video) == (walk, None, None)
    assert find_source([str(walk)]) == source
    assert whole_folder(walk) == whole_folder([walk]) == walk


def test_of_several_folders_names_begin_where_they_part(walk: Path) -> None:
    source = find_source([walk / "left", walk / "right"])
    assert (source.folder, source.names) == (walk, ("left/1.png", "left/2.png", "right/1.png"))
    assert source.given == (str(walk / "left"), str(walk / "right"))
    assert whole_folder([walk / "left", walk / "right"]) is None


def test_folders_and_photos_that_overlap_count_once(walk: Path) -> None:
    source = find_source([walk / "left", walk / "left" / "2.png", walk / "left" / ".." / "left"])
    assert (source.folder, source.names) == (walk / "left", ("1.png", "2.png"))


def test_a_list_holds_paths_relative_to_itself_or_absolute(walk: Path, tmp_path: Path) -> None:
    source = find_source(walk / "notes.txt")
    assert (source.folder, source.names) == (walk, ("left/1.png", "right/1.png"))
    elsewhere = tmp_path / "list.txt"
    elsewhere.write_text(f"{walk}/left/1.png\nwalk/other/deep/3.png\n")
    assert find_source(elsewhere).names == ("left/1.png", "other/deep/3.png")


def test_a_pattern_stands_for_photos_and_folders(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_source(str(walk / "*" / "1.png")).names == ("left/1.png", "right/1.png")
    monkeypatch.chdir(walk)
    assert find_source("[lr]*").names == ("left/1.png", "left/2.png", "right/1.png")
    assert find_source("**/*.png").names == ("left/1.png", "left/2.png", "other/deep/3.png", "right/1.png")


def test_a_folder_whose_name_looks_like_a_pattern_is_a_folder(tmp_path: Path) -> None:
    write_photo(tmp_path / "photos [1]" / "a.png", 0)
    assert find_source(tmp_path / "photos [1]").names is None


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (["nowhere"], "nowhere: no such folder or file"),
        (["left", "nowhere.png"], r"nowhere\.png: no such folder or file"),
        (["no*where"], r"no\*where: nothing fits this pattern"),
        (["data.csv"], r"data\.csv: is neither a photo .* nor a list of photos .* nor a video"),
        (["film.mp4", "left"], r"film\.mp4: a video must be given alone"),
        ([], "no photos named"),
        (["*.csv"], r"\*\.csv: no photos there"),
    ],
)
def test_what_is_no_photo_is_refused_by_name(
    walk: Path, given: list[str], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(walk)
    with pytest.raises(InputError, match=text):
        find_source(given)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("left/1.png\nleft/9.png\nno.png\n", r"2 of its photos are not there: .*left/9\.png, .*no\.png"),
        ("# nothing\n", "lists no photos"),
    ],
)
def test_a_list_that_does_not_fit_is_refused(walk: Path, content: str, text: str) -> None:
    (walk / "list.txt").write_text(content)
    with pytest.raises(InputError, match=rf"list\.txt: {text}"):
        find_source(walk / "list.txt")


def test_several_folders_make_a_scene_and_the_workspace_knows_them(walk: Path, tmp_path: Path) -> None:
    words = ["extract", str(walk / "left"), str(walk / "right"), str(tmp_path / "scene")]
    result = CliRunner().invoke(main, [*words, "--max-features", "300", "--threads", "1"])
    assert result.exit_code == 0, result.output
    workspace = Workspace(tmp_path / "scene")
    assert read_index(workspace).names == ["left/1.png", "left/2.png", "right/1.png"]
    assert workspace.images_dir == walk.resolve()
    assert workspace.command_for("images").startswith(f"corrsfm extract {walk}/left {walk}/right {tmp_path}")


def test_a_photo_that_vanished_is_not_taken_for_a_change_of_mind(walk: Path, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, [walk / "left", walk / "right"], cfg.ImagesConfig(), RUN)
    with pytest.raises(InputError, match="3 of the 3 photos of .* are not there.*--overwrite"):
        pipeline.index_photos(workspace, walk / "left", cfg.ImagesConfig(), RUN)
    pipeline.index_photos(workspace, walk / "left", cfg.ImagesConfig(), RUN, overwrite=True)
    assert read_index(workspace).names == ["1.png", "2.png"]


def test_a_forgotten_workspace_is_not_written_over_a_photo(walk: Path) -> None:
    before = (walk / "left" / "2.png").read_bytes()
    photos = [str(walk / "left" / name) for name in sorted(os.listdir(walk / "left"))]
    result = CliRunner().invoke(main, ["extract", *photos])
    assert result.exit_code == 1
    assert "is a file; expected a folder for the workspace" in result.output
    assert (walk / "left" / "2.png").read_bytes() == before


def test_options_of_a_video_are_of_no_use_for_photos(
    walk: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, walk / "left", cfg.ImagesConfig(frames=3), RUN)
    assert "no effect on photos" in caplog.text
