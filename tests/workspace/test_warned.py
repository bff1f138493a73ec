"""What each stage warned of, kept for the report."""

import logging
import threading
from pathlib import Path

import pytest

from corrsfm.workspace import Workspace
from corrsfm.workspace.heard import PASSING
from corrsfm.workspace.resume import StageOutcome
from corrsfm.workspace.warned import (
    MAX_CHARACTERS,
    MAX_WARNINGS,
    collect_warnings,
    keeps_warnings,
    read_warnings,
)

logger = logging.getLogger("corrsfm")


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path / "scene", create=True)


@keeps_warnings("features")
def stage(workspace: Workspace, *messages: str, skipped: bool = False, fails: bool = False) -> StageOutcome:
    for message in messages:
        logger.warning("%s", message)
    if fails:
        raise ValueError("no")
    return StageOutcome(stage="features", num_items=1, skipped=skipped)


def kept(workspace: Workspace) -> dict[str, list[str]]:
    return read_warnings(workspace.warnings_json)


def test_warnings_of_a_stage_are_kept_until_it_is_redone(workspace: Workspace) -> None:
    stage(workspace, "a", "b", "a")
    assert kept(workspace) == {"features": ["a", "b"]}
    stage(workspace, skipped=True)
    assert kept(workspace) == {"features": ["a", "b"]}
    stage(workspace, "c", skipped=True)
    assert kept(workspace) == {"features": ["c"]}
    stage(workspace)
    assert kept(workspace) == {"features": []}


def test_nothing_is_written_where_nothing_was_said(workspace: Workspace) -> None:
    stage(workspace)
    assert not workspace.warnings_json.exists()


def test_warnings_of_a_stage_that_fails_are_kept(workspace: Workspace) -> None:
    with pytest.raises(ValueError, match="no"):
        stage(workspace, "a", fails=True)
    assert kept(workspace) == {"features": ["a"]}


def test_other_stages_keep_theirs(workspace: Workspace) -> None:
    workspace.warnings_json.write_text('{"images": ["x"], "features": ["old"]}')
    stage(workspace, "new")
    assert kept(workspace) == {"images": ["x"], "features": ["new"]}


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b'{"features": 3}', b"\xff\xfe"])
def test_a_damaged_file_counts_as_empty_and_is_replaced(workspace: Workspace, content: bytes) -> None:
    workspace.warnings_json.write_bytes(content)
    assert kept(workspace) == {}
    stage(workspace, "a")
    assert kept(workspace) == {"features": ["a"]}


def test_a_file_that_cannot_be_written_stops_nothing(workspace: Workspace) -> None:
    workspace.warnings_json.mkdir()
    (workspace.warnings_json / "full").touch()
    stage(workspace, "a")
    with pytest.raises(ValueError, match="no"):
        stage(workspace, "a", fails=True)
    assert kept(workspace) == {}


def test_number_and_length_are_bounded() -> None:
    with collect_warnings() as messages:
        logger.warning("x" * (2 * MAX_CHARACTERS))
        for number in range(MAX_WARNINGS + 4):
            logger.warning("%d", number)
    assert len(messages[0]) == MAX_CHARACTERS + 2
    assert len(messages) == MAX_WARNINGS + 1
    assert messages[-1] == "5 more, in the terminal only"


def test_what_says_nothing_about_the_result_is_not_collected() -> None:
    with collect_warnings() as messages:
        logger.warning("waiting", extra=PASSING)
    assert messages == []


def test_only_warnings_of_this_thread_are_collected() -> None:
    with collect_warnings() as messages:
        other = threading.Thread(target=logger.warning, args=("elsewhere",))
        other.start()
        other.join()
        logger.info("not a warning")
        logger.getChild("prune").error("here")
    assert messages == ["here"]
    assert not [handler for handler in logger.handlers if type(handler).__name__ == "_Collector"]
