"""Workspaces: records of stages, locks, and clear refusals."""

import errno
import fcntl
import json
import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

from corrsfm import config as cfg
from corrsfm.cli import main
from corrsfm.errors import InputError, WorkspaceError
from corrsfm.workspace import StageRecord, Workspace
from corrsfm.workspace.commands import STAGE_COMMANDS


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


def test_a_path_too_long_for_databases_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    root = tmp_path.joinpath(*["long" * 20] * 5)
    with pytest.raises(
        WorkspaceError, match="longer than the 400 bytes .* choose a folder with a shorter one"
    ):
        Workspace(root, create=True)
    assert not list(tmp_path.iterdir())


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


def test_the_command_to_run_has_the_recorded_options_quoted_for_the_shell(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "my scene", create=True)
    assert workspace.command_for("features") == f"corrsfm extract PHOTOS '{workspace.root}'"
    workspace.images_dir = tmp_path / "photos"
    configs = {
        "images": cfg.ImagesConfig(skip_unreadable=True),
        "features": cfg.FeaturesConfig(max_features=3, root_sift=False),
        "pairs": cfg.PairsConfig(pairing=(cfg.PairStrategy.SEQUENTIAL, cfg.PairStrategy.SPATIAL)),
        "pruned matches": cfg.PruneConfig(method=cfg.PruneMethod.RATIO, model=Path("a b.pth")),
        "verified matches": cfg.DatabaseConfig(min_num_inliers=20),
        "models": cfg.ReconstructionConfig(),
    }
    for stage, config in configs.items():
        workspace.finish(stage, StageRecord(fingerprint="f", config=cfg.to_dict(config)))
    pairing = "--pairing sequential --pairing spatial"
    assert workspace.command_for("pairs") == f"corrsfm pairs '{workspace.root}' {pairing}"
    assert workspace.command_for("features") == (
        f"corrsfm extract {tmp_path}/photos '{workspace.root}' --skip-unreadable --max-features 3 "
        f"--no-root-sift {pairing}"
    )
    assert workspace.command_for("verified matches") == (
        f"corrsfm prune '{workspace.root}' --method ratio --model 'a b.pth' --min-num-inliers 20"
    )
    assert workspace.command_for("models") == f"corrsfm reconstruct '{workspace.root}'"


@pytest.mark.parametrize("stage", STAGE_COMMANDS)
def test_the_command_to_run_is_understood_by_the_command_line(workspace: Workspace, stage: str) -> None:
    others: dict[type, object] = {bool: True, int: 99, float: 0.5, str: "f,x,y"}
    not_given = {"max_ratio": 0.7}  # where None stands for a number, and not for a path
    num_flags = 0
    for name, options in (
        ("images", cfg.ImagesConfig), ("features", cfg.FeaturesConfig), ("pairs", cfg.PairsConfig),
        ("matches", cfg.MatchesConfig), ("pruned matches", cfg.PruneConfig),
        ("verified matches", cfg.DatabaseConfig), ("models", cfg.ReconstructionConfig),
    ):  # fmt: skip
        changed = {}
        for key, value in cfg.to_dict(options()).items():
            changed[key] = value
            if not isinstance(value, str | list):
                changed[key] = others.get(type(value), not_given.get(key, "x"))
            if isinstance(value, bool):
                changed[key] = not value
            num_flags += changed[key] != value
        workspace.finish(name, StageRecord(fingerprint="f", config=changed))
    assert num_flags > 20
    _, command, *words = shlex.split(workspace.command_for(stage))
    main.commands[command].make_context(command, words)


def test_a_folder_that_is_no_workspace_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="not a corrsfm workspace; make one with: corrsfm extract"):
        Workspace(tmp_path)


@pytest.mark.parametrize("name", ["database.db", "images.txt", "images.json", ".photos.json", "log.txt"])
def test_a_folder_with_files_that_would_be_replaced_is_not_touched(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"{}")
    with pytest.raises(WorkspaceError, match=f"holds {re.escape(name)} of another tool"):
        Workspace(tmp_path, create=True)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_bytes() == b"{}"


def test_another_tools_manifest_is_not_called_damaged(tmp_path: Path) -> None:
    (tmp_path / "workspace.json").write_text('{"folders": []}')
    with pytest.raises(WorkspaceError, match="is of another tool; choose another folder"):
        Workspace(tmp_path, create=True)


def test_a_pipe_in_the_place_of_the_lock_holds_nobody_up(workspace: Workspace) -> None:
    os.mkfifo(workspace.root / ".lock")
    with workspace.reading():
        pass
    with pytest.raises(WorkspaceError, match=r"expected a file; run: rm -r .*\.lock"), workspace.lock():
        pass


@pytest.mark.parametrize("present", [[], ["0.jpg", "notes.txt"]])
def test_a_workspace_begun_with_unusable_input_vanishes_and_nothing_else_does(
    tmp_path: Path, present: list[str]
) -> None:
    root = tmp_path / "new" / "scene"
    if present:
        root.mkdir(parents=True)
    for name in present:
        (root / name).touch()
    workspace = Workspace(root, create=True)
    with pytest.raises(InputError), workspace.lock():
        workspace.log.touch()
        raise InputError("no photos")
    assert sorted(path.name for path in root.glob("*")) == present
    assert root.parent.exists() == bool(present)


def test_unusable_input_costs_a_workspace_nothing_that_it_holds(workspace: Workspace) -> None:
    for begun in (workspace, Workspace(workspace.root, create=True)):
        begun.finish("features", StageRecord(fingerprint="f"))
        with pytest.raises(InputError), begun.lock():
            raise InputError("no photos")
        assert begun.manifest.exists()
    workspace.photo_cache.write_text('{"photos": {}}')
    workspace.manifest.unlink()
    again = Workspace(workspace.root, create=True)
    with pytest.raises(InputError), again.lock():
        raise InputError("no photos")
    assert again.photo_cache.exists()


def test_after_a_failed_mapping_the_report_says_why_there_are_no_models(workspace: Workspace) -> None:
    workspace.finish("verified matches", StageRecord(fingerprint="f"))
    workspace.put_models_aside()
    with pytest.raises(WorkspaceError, match="mapping gave no model; why: corrsfm report "):
        workspace.require("models")


def test_a_link_in_the_place_of_the_lock_is_not_followed(workspace: Workspace, tmp_path: Path) -> None:
    (tmp_path / "diary").write_text("precious")
    (workspace.root / ".lock").symlink_to(tmp_path / "diary")
    with pytest.raises(WorkspaceError, match=".lock: is a link, expected a file"), workspace.lock():
        pass
    assert (tmp_path / "diary").read_text() == "precious"


def test_a_workspace_without_its_manifest_goes_on(workspace: Workspace) -> None:
    workspace.images_json.write_text('{"cameras": [], "images": []}')
    workspace.database.touch()
    workspace.manifest.write_text("{")
    with pytest.raises(WorkspaceError, match="remove it alone, with: rm -r .*; then run the commands"):
        Workspace(workspace.root, create=True)
    workspace.manifest.unlink()
    assert Workspace(workspace.root, create=True).record_of("images") is None
    assert workspace.database.exists()


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "scene").touch()
    with pytest.raises(WorkspaceError, match="is a file"):
        Workspace(tmp_path / "scene", create=True)


def test_another_format_version_is_refused(workspace: Workspace) -> None:
    workspace.manifest.write_text(json.dumps({"format_version": 99, "stages": {}}))
    with pytest.raises(WorkspaceError, match="format version 99"):
        Workspace(workspace.root)


@pytest.mark.parametrize(
    "text",
    [
        "", "{", "[]", "{}", '{"format_version": 1}',
        '{"format_version": 1, "images_dir": null, "stages": []}',
        '{"format_version": 1, "images_dir": null, "stages": {"models": {"colour": 1}}}',
    ],
)  # fmt: skip
def test_a_damaged_manifest_is_refused(workspace: Workspace, text: str) -> None:
    workspace.manifest.write_text(text)
    with pytest.raises(WorkspaceError, match="damaged"):
        Workspace(workspace.root)


def test_a_second_process_cannot_lock_a_workspace(workspace: Workspace) -> None:
    code = (
        "import sys; from pathlib import Path; from corrsfm.workspace import Workspace\n"
        "from corrsfm.errors import InputError, WorkspaceError\n"
        "try:\n"
        "    with Workspace(Path(sys.argv[1])).lock(): print('locked')\n"
        "except WorkspaceError as error: print(error)\n"
    )
    command = [sys.executable, "-c", code, str(workspace.root)]
    with workspace.lock():
        output = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert "another corrsfm works in this folder" in output
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "locked\n"


def test_one_that_waits_begins_a_workspace_anew_that_the_first_gave_up(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from corrsfm.workspace import Workspace\n"
        "workspace = Workspace(Path(sys.argv[1]), create=True); print('begun', flush=True)\n"
        "with workspace.lock(wait=True): print(workspace.manifest.exists())\n"
    )
    first = Workspace(tmp_path / "scene", create=True)
    with pytest.raises(InputError), first.lock():
        second = subprocess.Popen(
            [sys.executable, "-c", code, str(first.root)], stdout=subprocess.PIPE, text=True
        )
        assert second.stdout is not None and second.stdout.readline() == "begun\n"
        time.sleep(1.0)
        raise InputError("no photos")
    assert second.communicate()[0] == "True\n"
    assert second.returncode == 0


def test_a_failing_lock_is_not_taken_for_another_process(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(WorkspaceError, match=r"cannot be locked \(Input/output error\)"), workspace.lock():
        pass


def test_a_workspace_that_cannot_be_written_is_refused(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(WorkspaceError, match="nothing can be written there.*copy"), workspace.lock():
        pass


def test_models_put_aside_take_their_reports_along(workspace: Workspace) -> None:
    def make(content: str) -> None:
        workspace.finish("models", StageRecord(fingerprint="f"))
        (workspace.sparse / "0").mkdir(parents=True)
        workspace.run_json.write_text(content)

    make("first")
    workspace.report_html.write_text("first")
    workspace.added.write_text("{}")
    workspace.adding.write_text("{}")
    workspace.put_models_aside()
    aside = workspace.root / "sparse.old"
    assert workspace.record_of("models") is None
    assert not workspace.sparse.exists() and not workspace.run_json.exists()
    assert not workspace.adding.exists()
    assert sorted(path.name for path in aside.iterdir()) == ["0", "added.json", "report.html", "run.json"]
    workspace.put_models_aside()
    assert (aside / "run.json").read_text() == "first"
    make("second")
    workspace.put_models_aside()
    second = workspace.root / "sparse.old.2"
    assert sorted(path.name for path in second.iterdir()) == ["0", "run.json"]
    assert (second / "run.json").read_text() == "second"
    assert (aside / "run.json").read_text() == "first"


def test_the_folder_of_the_photos_is_no_workspace_and_stays_as_it_is(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="is the folder of the photos; choose another"):
        Workspace(tmp_path, create=True, images_dir=tmp_path / "." / "sub" / "..")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "images").mkdir()
    assert Workspace(tmp_path, create=True, images_dir=tmp_path / "images").root == tmp_path


def test_a_failed_mapping_is_remembered_until_the_matches_change_or_it_succeeds(workspace: Workspace) -> None:
    workspace.finish("verified matches", StageRecord(fingerprint="first"))
    assert not workspace.mapping_failed
    workspace.put_models_aside()
    assert workspace.mapping_failed and Workspace(workspace.root).mapping_failed
    workspace.finish("verified matches", StageRecord(fingerprint="second"))
    assert not workspace.mapping_failed
    workspace.put_models_aside()
    workspace.finish("models", StageRecord(fingerprint="f"))
    assert not workspace.mapping_failed
