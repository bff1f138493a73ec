"""What is said of a finished scene: who is weakly held, what is missing, what to try first."""

import json
import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner
from finished_scene import LEFT_OUT, FinishedScene, make_finished_scene
from scene_to_grow import contents

import corrsfm.finished.check as checking
from corrsfm.cli import main
from corrsfm.errors import WorkspaceError
from corrsfm.finished.advice import next_step
from corrsfm.finished.check import check_workspace
from corrsfm.report.missing import MissingPhoto, MissingReason
from corrsfm.report.stage import summarise
from corrsfm.report.statistics import SceneReport, make_report
from corrsfm.types import ModelSummary, PairStatistics
from corrsfm.workspace import StageRecord, Workspace


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FinishedScene:
    # What a made scene lacks of a real one is no damage.
    monkeypatch.setattr(checking, "find_damage", lambda _: [])
    made = make_finished_scene(tmp_path / "made", camera="SIMPLE_RADIAL")
    workspace = Workspace(made.workspace)
    for stage in ("images", "features", "pairs", "matches", "pruned matches", "verified matches"):
        workspace.finish(stage, StageRecord(fingerprint=stage))
    return made


def pair(name0: str, name1: str, verified: int, kept: int | None = None) -> PairStatistics:
    kept = verified if kept is None else kept
    return PairStatistics(name0=name0, name1=name1, num_putative=500, num_kept=kept, num_verified=verified)


def model_of(*names: str) -> ModelSummary:
    return ModelSummary(
        image_names=names, num_points=100, num_observations=300, mean_track_length=3.0,
        mean_observations_per_image=60.0, mean_error_px=0.5, median_error_px=0.5, p95_error_px=1.0,
    )  # fmt: skip


def report_of(
    pairs: list[PairStatistics], *models: ModelSummary, evidence: dict | None = None
) -> SceneReport:
    names = {name for one in pairs for name in (one.name0, one.name1)}
    return make_report(scene="made", image_names=names, pairs=pairs, models=models, evidence=evidence)


def check_of(scene: FinishedScene, report: SceneReport, monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    """The check of a workspace whose report is another."""
    _, models = summarise(Workspace(scene.workspace))
    monkeypatch.setattr(checking, "summarise", lambda _: (report, models if report.models else []))
    return check_workspace(scene.workspace)


def test_a_missing_photo_is_named_with_its_reason_and_a_command(scene: FinishedScene) -> None:
    before = contents(scene.workspace)
    result = check_workspace(scene.workspace)
    assert contents(scene.workspace) == before
    assert (result.num_registered, result.num_photos, result.grade) == (5, 6, "good")
    assert [photo.name for photo in result.missing] == [LEFT_OUT]
    (finding,) = [one for one in result.findings if one.kind in ("missing", "parts")]
    assert LEFT_OUT in finding.text or LEFT_OUT in finding.photos
    assert "corrsfm" in finding.next_step and str(scene.workspace) in finding.next_step


def test_a_photo_that_cannot_be_read_goes_on_with_the_command_that_brought_it(scene: FinishedScene) -> None:
    workspace = Workspace(scene.workspace)
    photo = MissingPhoto(name="cut.jpg", reason=MissingReason.LEFT_OUT, detail="cannot be read", next_step="")
    assert next_step(photo, workspace).startswith("replace the file, then: corrsfm extract ")
    workspace.adding.write_text("{}")
    assert next_step(photo, workspace) == f"replace the file, then: corrsfm add {scene.workspace}"


def test_photos_that_changed_or_went_away_are_named(scene: FinishedScene) -> None:
    def said() -> list[tuple[tuple[str, ...], str]]:
        found = check_workspace(scene.workspace).findings
        return [(one.photos, one.next_step) for one in found if one.kind == "photos"]

    assert not said()
    (scene.photos / "1.png").write_bytes((scene.photos / "2.png").read_bytes())
    (scene.photos / "3.png").unlink()
    (gone, _), (changed, step) = said()
    assert (gone, changed) == (("3.png",), ("1.png",))
    assert step.startswith(f"put the earlier ones back, or run: corrsfm extract {scene.photos}")
    scene.photos.rename(scene.photos.with_name("moved"))
    ((photos, step),) = said()
    assert not photos and f"corrsfm extract NEWDIR {scene.workspace}" in step


def test_photos_are_listed_by_what_holds_them(scene: FinishedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, c, d, e = scene.names
    pairs = [
        pair(a, b, 100),
        pair(a, c, 100),
        pair(b, c, 100),
        pair(c, d, 100),
        pair(d, e, 50),
        pair(c, e, 2),
    ]
    explained = [
        {"name0": one.name0, "name1": one.name1, "num_verified": one.num_verified, "num_explained": num}
        for one, num in zip(pairs, [100, 100, 100, 100, 20, 2], strict=True)
    ]
    result = check_of(
        scene, report_of(pairs, model_of(*scene.names), evidence={"pairs": explained}), monkeypatch
    )
    assert {photo.name for photo in result.photos[:2]} == {d, e}
    by_name = {photo.name: photo for photo in result.photos}
    # The model contradicts d – e.
    assert by_name[d].weakness == f"held by one pair only, with {c}"
    assert by_name[e].weakness == f"held by one pair only, with {c}"
    assert not by_name[a].weakness and by_name[a].num_pairs == 2
    (finding,) = [one for one in result.findings if one.kind == "weak"]
    assert set(finding.photos) == {d, e} and "corrsfm add" in finding.next_step


def test_parts_come_with_the_pairs_that_nearly_bridge_them(
    scene: FinishedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b, c, d, e = scene.names
    pairs = [pair(a, b, 100), pair(b, c, 100), pair(d, e, 80), pair(c, d, 0, 12), pair(a, d, 0, 3)]
    result = check_of(scene, report_of(pairs, model_of(a, b, c), model_of(d, e)), monkeypatch)
    assert result.parts == ((a, b, c), (d, e))
    assert [(bridge.name0, bridge.name1, bridge.num_kept) for bridge in result.bridges] == [
        (c, d, 12),
        (a, d, 3),
    ]
    (finding,) = [one for one in result.findings if one.kind == "parts"]
    assert finding.photos == (d, e)
    assert "--min-num-inliers 10" in finding.next_step and "corrsfm reconstruct" in finding.next_step


def test_a_gap_without_matches_asks_for_photos(scene: FinishedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, c, d, e = scene.names
    pairs = [pair(a, b, 100), pair(b, c, 100), pair(d, e, 80), pair(c, d, 0, 4)]
    attempt = {"photos0": [a, b, c], "photos1": [d, e], "is_joined": False, "reason": "3 points agree"}
    report = report_of(pairs, model_of(a, b, c), model_of(d, e), evidence={"joinings": [attempt]})
    result = check_of(scene, report, monkeypatch)
    (finding,) = [one for one in result.findings if one.kind == "parts"]
    assert finding.text.endswith("with 4 kept matches; not joined: 3 points agree")
    assert finding.next_step.startswith(
        f"take photos between {c} and {d}, put them into {scene.photos}, then: "
    )
    assert "corrsfm extract" in finding.next_step and "corrsfm reconstruct" in finding.next_step


@pytest.mark.parametrize(
    ("advice", "flags"),
    [
        ("a larger --max-models-tried, or more photos", ["--max-models-tried", "48"]),
        ("another --seed, or more photos", ["--seed", "1"]),
    ],
)
def test_a_wrong_model_comes_first_and_ends_with_a_code(
    scene: FinishedScene, advice: str, flags: list[str]
) -> None:
    verdict = {"grade": "wrong", "reasons": ["bent"], "next_steps": [advice]}
    evidence = scene.workspace / "evidence.json"
    evidence.write_text(json.dumps({"verdict": verdict}))
    Workspace(scene.workspace).finish("models", StageRecord(fingerprint="made up"))
    result = check_workspace(scene.workspace)
    assert result.findings[0].kind == "verdict" and not result.is_usable
    assert shlex.split(result.findings[0].next_step)[-2:] == flags
    shown = CliRunner().invoke(main, ["check", str(scene.workspace)])
    assert shown.exit_code == 1 and "1. the model is wrong: bent" in shown.stdout
    values = json.loads(CliRunner().invoke(main, ["check", str(scene.workspace), "--json"]).stdout)
    assert values["is_usable"] is False and values["next_steps"][0] == result.findings[0].next_step


def test_a_scene_without_models_says_what_to_do(
    scene: FinishedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    a, b, *_ = scene.names
    result = check_of(scene, report_of([pair(a, b, 20)]), monkeypatch)
    assert result.findings[0].kind == "model" and "corrsfm reconstruct" in result.findings[0].next_step
    assert not result.is_usable and not result.photos


def test_an_unfinished_or_locked_workspace_is_refused(scene: FinishedScene) -> None:
    with Workspace(scene.workspace).lock(), pytest.raises(WorkspaceError, match="another corrsfm works"):
        check_workspace(scene.workspace)
    Workspace(scene.workspace).forget("verified matches")
    with pytest.raises(WorkspaceError, match="no verified matches yet; run: corrsfm prune"):
        check_workspace(scene.workspace)
