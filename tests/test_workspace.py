"""Workspaces: records of stages, locks, and clear refusals."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from corrsfm.errors import WorkspaceError
from corrsfm.workspace import StageRecord, Workspace


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path / "scene", create=True)


def test_records_survive_reopening(workspace: Workspace) -> None:
    workspace.finish("features", StageRecord(fingerprint="f", config={"max_features": 3}, seconds=1.5))
    record = Workspace(workspace.root).record_of("features")
    assert record is not None
    assert (record.fingerprint, record.config, record.seconds) == ("f", {"max_features": 3}, 1.5)


def test_a_stage_is_current_only_with_its_fingerprint_and_its_file(workspace: Workspace) -> None:
    workspace.finish("features", StageRecord(fingerprint="f"))
    assert not workspace.is_current("features", "f", workspace.features)
    workspace.features.touch()
    assert workspace.is_current("features", "f", workspace.features)
    assert not workspace.is_current("features", "g", workspace.features)
    workspace.forget("features")
    assert not workspace.is_current("features", "f", workspace.features)


def test_a_missing_stage_names_the_command_that_makes_it(workspace: Workspace) -> None:
    with pytest.raises(WorkspaceError, match=f"no matches yet; run: corrsfm match {workspace.root}"):
        workspace.require("matches")


def test_a_stage_whose_input_changed_names_the_command_that_redoes_it(workspace: Workspace) -> None:
    workspace.finish("features", StageRecord(fingerprint="f1"))
    workspace.finish("matches", StageRecord(fingerprint="m", inputs={"features": "f1"}))
    workspace.finish("pruned matches", StageRecord(fingerprint="p", inputs={"matches": "m"}))
    assert workspace.require("pruned matches").fingerprint == "p"
    workspace.finish("features", StageRecord(fingerprint="f2"))
    with pytest.raises(WorkspaceError, match="matches are older than features; run: corrsfm match"):
        workspace.require("pruned matches")


def test_a_folder_that_is_no_workspace_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="not a corrsfm workspace; make one with: corrsfm extract"):
        Workspace(tmp_path)


def test_a_folder_with_another_tools_database_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "database.db").write_bytes(b"precious")
    with pytest.raises(WorkspaceError, match=r"database\.db of another tool"):
        Workspace(tmp_path, create=True)
    assert [path.name for path in tmp_path.iterdir()] == ["database.db"]


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene").touch()
    with pytest.raises(WorkspaceError, match="is a file"):
        Workspace(tmp_path / "scene", create=True)


def test_another_format_version_is_refused(workspace: Workspace) -> None:
    workspace.manifest.write_text(json.dumps({"format_version": 99, "stages": {}}))
    with pytest.raises(WorkspaceError, match="format version 99"):
        Workspace(workspace.root)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}"])
def test_a_damaged_manifest_is_refused(workspace: Workspace, text: str) -> None:
    workspace.manifest.write_text(text)
    with pytest.raises(WorkspaceError, match="damaged"):
        Workspace(workspace.root)


def test_a_second_process_cannot_lock_a_workspace(workspace: Workspace) -> None:
    code = (
        "import sys; from pathlib import Path; from corrsfm.workspace import Workspace\n"
        "from corrsfm.errors import WorkspaceError\n"
        "try:\n"
        "    with Workspace(Path(sys.argv[1])).lock(): print('locked')\n"
        "except WorkspaceError as error: print(error)\n"
    )
    command = [sys.executable, "-c", code, str(workspace.root)]
    with workspace.lock():
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert "another corrsfm works in this workspace" in output
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "locked\n"
