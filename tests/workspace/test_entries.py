"""Nothing is written through a link in a workspace, and nothing is read from a pipe there."""

import os
from pathlib import Path

import pytest

from corrsfm.errors import WorkspaceError
from corrsfm.workspace import Workspace

OWN = (
    "workspace.json", "images.txt", "images.json", ".photos.json", "features.db", "features.db-wal",
    "pairs.txt", "pair_origins.tsv", "matches.db", "pruned", "pruned/ratio.db", "cameras.json", "database.db",
    "sparse", "sparse/0", "sparse/0/points3D.bin", "evidence.json", "added.json", "adding.json",
    "warnings.json", "report.json", "report.html", "run.json", "log.txt", "frames", ".candidates", ".seeds",
)  # fmt: skip


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path / "scene", create=True)


@pytest.mark.parametrize("name", OWN)
def test_links_are_not_followed_for_writing(workspace: Workspace, name: str, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("precious")
    place = workspace.root / name
    place.parent.mkdir(parents=True, exist_ok=True)
    if place.exists():
        place.rename(outside / "moved")
    is_folder = "." not in place.name.lstrip(".") and not place.name.endswith(".json")
    place.symlink_to(
        outside if is_folder else outside / ("moved" if name == "workspace.json" else "precious")
    )
    with (
        pytest.raises(WorkspaceError, match=f"{place.name}: is a link, and nothing is written through links"),
        Workspace(workspace.root).lock(),
    ):
        pass
    assert (outside / "precious").read_text() == "precious"


def test_the_lock_is_no_link(workspace: Workspace, tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("precious")
    (workspace.root / ".lock").symlink_to(tmp_path / "precious")
    with pytest.raises(WorkspaceError), workspace.lock():
        pass
    assert (tmp_path / "precious").read_text() == "precious"


@pytest.mark.parametrize("name", ["images.json", "features.db", "sparse/0/cameras.bin", "log.txt"])
def test_pipes_are_named_and_not_waited_for(workspace: Workspace, name: str) -> None:
    (workspace.root / name).parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(workspace.root / name)
    for hold in (workspace.lock, workspace.reading):
        with pytest.raises(WorkspaceError, match=f"{Path(name).name}: is a pipe or device"), hold():
            pass


def test_a_workspace_may_be_reached_through_a_link_and_hold_links_of_others(
    workspace: Workspace, tmp_path: Path
) -> None:
    (tmp_path / "other").symlink_to(workspace.root)
    (workspace.root / "notes").symlink_to(tmp_path)
    (workspace.converted).mkdir()
    (workspace.converted / "a.jpg").symlink_to("/nowhere")
    with Workspace(tmp_path / "other").lock():
        pass


def test_a_manifest_with_a_changed_record_is_damaged(workspace: Workspace) -> None:
    text = workspace.manifest.read_text(encoding="utf-8")
    workspace.manifest.write_text(text.replace('"stages": {}', '"stages": {"pairs": {"fingerprint": "x"}}'))
    with pytest.raises(
        WorkspaceError, match=r"workspace\.json: damaged .*not as it was written.*remove it alone"
    ):
        Workspace(workspace.root)


@pytest.mark.parametrize(
    "name", ["report.html", ".photos.json", "pair_origins.tsv", "database.db-wal", "pruned/ratio.db-journal"]
)
def test_a_folder_in_the_place_of_a_file_is_named(workspace: Workspace, name: str) -> None:
    (workspace.root / name).mkdir(parents=True)
    for use in (workspace.lock, workspace.reading):
        with pytest.raises(WorkspaceError, match=f"{name}: is in the place of a file.*run: rm -r "), use():
            pass


@pytest.mark.parametrize("name", ["pruned", "sparse", ".candidates"])
def test_a_file_in_the_place_of_a_folder_is_named(workspace: Workspace, name: str) -> None:
    (workspace.root / name).write_text("notes")
    with (
        pytest.raises(WorkspaceError, match=f"{name}: is in the place of a folder.*run: rm "),
        workspace.lock(),
    ):
        pass
