"""A look at a finished scene: what holds its model weakly, what is missing, and what to try next."""

from __future__ import annotations

import dataclasses
import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from corrsfm.errors import first_few
from corrsfm.finished.advice import command_again, more_photos_to_add, more_photos_to_map, next_step
from corrsfm.finished.integrity import Damage, find_damage
from corrsfm.images.cache import PhotoCache, photos_unlike
from corrsfm.reconstruction.explained import CONTRADICTED_BELOW
from corrsfm.report.missing import MissingPhoto
from corrsfm.report.stage import summarise
from corrsfm.report.statistics import SceneReport
from corrsfm.types import PairStatistics
from corrsfm.workspace import Workspace
from corrsfm.workspace.last_run import seed_of_last_run
from corrsfm.workspace.lists import read_added, read_index

__all__ = ["Bridge", "HeldPhoto", "SceneFinding", "WorkspaceCheck", "check_workspace"]

# What COLMAP's mapper wants of a photo before it registers it.
FEWEST_POINTS = 30
# A photo with nearly all its matches in one pair turns with the errors of that one.
MOST_IN_ONE_PAIR = 0.9
# Fewer kept matches than this are chance, so a lower --min-num-inliers would gain nothing true.
_FEWEST_TO_LOWER_FOR = 10
_NUM_BRIDGES = 3


@dataclass(frozen=True, kw_only=True)
class HeldPhoto:
    """How firmly a registered photo is held.

    Attributes
    ----------
    name : str
    num_pairs : int
        Verified pairs with registered photos that the model does not contradict.
    num_points : int
        Points of the model that it sees.
    strongest : str
        The photo that most of its matches are with; empty if there is none.
    strongest_share : float
        Share of its matches that are with that one.
    weakness : str
        What is weak about it; empty if nothing is.
    """

    name: str
    num_pairs: int
    num_points: int
    strongest: str
    strongest_share: float
    weakness: str = ""


@dataclass(frozen=True, kw_only=True)
class Bridge:
    """A pair that would connect two parts of the pair graph if more of its matches held.

    Attributes
    ----------
    name0, name1 : str
        In the largest part, and in the other.
    part : int
        Index of the other part.
    num_putative, num_kept : int
    """

    name0: str
    name1: str
    part: int
    num_putative: int
    num_kept: int


@dataclass(frozen=True, kw_only=True)
class SceneFinding:
    """Something to know about a finished scene.

    Attributes
    ----------
    kind : str
        ``damage``, ``photos``, ``model``, ``verdict``, ``parts``, ``models``, ``missing`` or ``weak``.
    text : str
    photos : tuple of str
    next_step : str
        To paste, or what to do.
    """

    kind: str
    text: str
    photos: tuple[str, ...]
    next_step: str


@dataclass(frozen=True, kw_only=True)
class WorkspaceCheck:
    """What was found in a workspace.

    Attributes
    ----------
    num_photos, num_registered : int
        Photos of the scene, and those in the first model.
    grade : str or None
        Of the verdict on the first model; None if there is none.
    verdict : str
        In one line; empty if there is none.
    photos : tuple of HeldPhoto
        Registered photos, the most weakly held first.
    parts : tuple of tuple of str
        Components of the graph of verified pairs, the largest first.
    bridges : tuple of Bridge
        The most promising pairs between the largest part and each other one.
    missing : tuple of MissingPhoto
    findings : tuple of SceneFinding
        What to try first comes first: a wrong model, then what could gain most photos, then what is weak.
        Where files are damaged, only that.
    """

    num_photos: int
    num_registered: int
    grade: str | None
    verdict: str
    photos: tuple[HeldPhoto, ...]
    parts: tuple[tuple[str, ...], ...]
    bridges: tuple[Bridge, ...]
    missing: tuple[MissingPhoto, ...]
    findings: tuple[SceneFinding, ...]

    @property
    def is_usable(self) -> bool:
        """Whether there is a model and the verdict on it is not "wrong"."""
        return self.num_registered > 0 and self.grade != "wrong"

    @property
    def next_steps(self) -> tuple[str, ...]:
        """What to try, in order of promise, each once."""
        return tuple(dict.fromkeys(finding.next_step for finding in self.findings))

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            **dataclasses.asdict(self),
            "is_usable": self.is_usable,
            "next_steps": list(self.next_steps),
        }


def check_workspace(workspace: Path | str, *, integrity: bool = True) -> WorkspaceCheck:
    """Say what is weak about a reconstructed scene and what to try next; nothing is changed.

    Parameters
    ----------
    workspace : path
    integrity : bool
        First read every item of every file, see `corrsfm.finished.integrity.find_damage`.

    Returns
    -------
    WorkspaceCheck

    Raises
    ------
    WorkspaceError
        If its matches are not verified yet, or another process works there.
    """
    scene = Workspace(Path(workspace))
    with scene.reading():
        if damage := find_damage(scene) if integrity else []:
            return _damaged(damage)
        report, models = summarise(scene)
        held = _held_photos(report, models[0]) if models else ()
        bridges = _bridges(report)
        findings = [
            *(_photos(scene) if integrity else []),
            *_model(report, scene),
            *_verdict(report, scene),
            *sorted(
                [*_parts(report, bridges, scene), *_models(report, scene), *_missing(report, scene)],
                key=lambda finding: -len(finding.photos),
            ),
            *_weak(held, scene),
        ]
    return WorkspaceCheck(
        num_photos=len(report.image_names),
        num_registered=report.num_registered,
        grade=report.evidence.get("verdict", {}).get("grade"),
        verdict=report.verdict,
        photos=held,
        parts=report.components,
        bridges=bridges,
        missing=report.missing,
        findings=tuple(findings),
    )


def _damaged(damage: Sequence[Damage]) -> WorkspaceCheck:
    """What can be said of a scene with damaged files: how to mend them."""
    findings = tuple(
        SceneFinding(kind="damage", text=f"{one.path}: {one.problem}", photos=(), next_step=one.remedy)
        for one in damage
    )
    return WorkspaceCheck(
        num_photos=0, num_registered=0, grade=None, verdict="", photos=(), parts=(), bridges=(), missing=(),
        findings=findings,
    )  # fmt: skip


def _photos(scene: Workspace) -> list[SceneFinding]:
    """Photos that are no longer what was reconstructed; all that other tools get of the scene needs them."""
    records = read_index(scene).records
    missing, changed = photos_unlike(records, scene.images_dir, PhotoCache(scene.photo_cache))
    found, source = [], None
    # Frames and converted photos are made again, but photos that were added lie among them alone.
    are_ours = scene.has_own_photos
    if are_ours and read_added(scene):
        source, are_ours = str(scene.images_dir), False
    elif are_ours and not all(map(os.path.exists, scene.given_photos)):
        source = "VIDEO" if scene.is_sequence else "PHOTOS"
    again = command_again(scene, "images", images_dir=source)
    if len(missing) == len(records):
        moved = scene.command_for("images", images_dir="NEWDIR")
        text, step = f"the photos are no longer in {scene.images_dir}", f"put them back, or run: {moved}"
        found.append(SceneFinding(kind="photos", text=text, photos=(), next_step=step))
    elif missing:
        text = f"photos that are no longer in {scene.images_dir}, or cannot be read: {first_few(missing)}"
        step = f"put them back, or {'make them again' if are_ours else 'leave them out'}, with: {again}"
        found.append(SceneFinding(kind="photos", text=text, photos=tuple(missing), next_step=step))
    if changed:
        text = f"photos that have changed since they were reconstructed: {first_few(changed)}"
        step = f"put the earlier ones back, or run: {again}"
        found.append(SceneFinding(kind="photos", text=text, photos=tuple(changed), next_step=step))
    return found


def _held_photos(report: SceneReport, model: pycolmap.Reconstruction) -> tuple[HeldPhoto, ...]:
    """Every registered photo and what holds it, the weakest first."""
    num_points = {image.name: image.num_points3D for image in model.images.values() if image.has_pose}
    matches: dict[str, Counter[str]] = defaultdict(Counter)
    for name0, name1, num in _holding(report):
        if name0 in num_points and name1 in num_points:
            matches[name0][name1] += num
            matches[name1][name0] += num
    held = []
    for name in sorted(num_points):
        others = matches[name]
        strongest, most = max(others.items(), key=lambda item: (item[1], item[0]), default=("", 0))
        share = most / others.total() if others else 0.0
        photo = HeldPhoto(
            name=name,
            num_pairs=len(others),
            num_points=num_points[name],
            strongest=strongest,
            strongest_share=share,
        )
        held.append(dataclasses.replace(photo, weakness=_weakness(photo)))
    return tuple(sorted(held, key=lambda one: (not one.weakness, one.num_pairs, one.num_points, one.name)))


def _holding(report: SceneReport) -> list[tuple[str, str, int]]:
    """Pairs that hold photos, and by how many matches: explained ones if the model was judged."""
    if "pairs" not in report.evidence:
        return [(pair.name0, pair.name1, pair.num_verified) for pair in report.pairs if pair.num_verified]
    return [
        (pair["name0"], pair["name1"], pair["num_explained"])
        for pair in report.evidence["pairs"]
        if pair["num_explained"] and pair["num_explained"] >= CONTRADICTED_BELOW * pair["num_verified"]
    ]


def _weakness(photo: HeldPhoto) -> str:
    if not photo.num_pairs:
        return "no verified pair agrees with its place"
    if photo.num_pairs == 1:
        return f"held by one pair only, with {photo.strongest}"
    if photo.num_points < FEWEST_POINTS:
        return f"sees only {photo.num_points} points"
    if photo.strongest_share > MOST_IN_ONE_PAIR:
        return f"{photo.strongest_share:.0%} of its matches are with {photo.strongest}"
    return ""


def _bridges(report: SceneReport) -> tuple[Bridge, ...]:
    """The pairs between the largest part and each other one that come nearest to being verified."""
    part_of = {name: number for number, part in enumerate(report.components) for name in part}
    between: dict[int, list[PairStatistics]] = defaultdict(list)
    for pair in report.pairs:
        parts = sorted({part_of.get(pair.name0, -1), part_of.get(pair.name1, -1)})
        if len(parts) == 2 and parts[0] == 0:
            between[parts[1]].append(pair)
    bridges = []
    for part in range(1, len(report.components)):
        best = sorted(between[part], key=lambda pair: (-pair.num_kept, -pair.num_putative, pair.name0))
        for pair in best[:_NUM_BRIDGES]:
            inside = part_of[pair.name0] == 0
            bridges.append(
                Bridge(
                    name0=pair.name0 if inside else pair.name1,
                    name1=pair.name1 if inside else pair.name0,
                    part=part,
                    num_putative=pair.num_putative,
                    num_kept=pair.num_kept,
                )
            )
    return tuple(bridges)


def _model(report: SceneReport, workspace: Workspace) -> list[SceneFinding]:
    if report.models:
        return []
    text = "mapping made no model" if workspace.mapping_failed else "there is no model yet"
    step = (
        command_again(workspace, "pruned matches", "--min-num-inliers", "10")
        if workspace.mapping_failed
        else workspace.command_for("models")
    )
    return [SceneFinding(kind="model", text=text, photos=(), next_step=step)]


def _verdict(report: SceneReport, workspace: Workspace) -> list[SceneFinding]:
    """What the verdict says, unless there is nothing to do about it."""
    verdict = report.evidence.get("verdict")
    if verdict is None or not verdict["next_steps"]:
        return []
    advice = "; or ".join(verdict["next_steps"])
    step = f"try {advice}"
    if "--max-models-tried" in advice:
        tried = int(report.configuration.get("models", {}).get("max_models_tried", 24))
        step = command_again(workspace, "models", "--max-models-tried", str(2 * tried))
    elif "--seed" in advice:
        seed = seed_of_last_run(workspace) or 0
        step = command_again(workspace, "models", "--seed", str(seed + 1))
    elif "--camera-mode single" in advice:
        step = command_again(workspace, "images", "--camera-mode", "single")
    text = f"the model is {verdict['grade']}: {'; '.join(verdict['reasons'])}"
    photos = tuple(report.evidence.get("misplaced_photos", ()))
    return [SceneFinding(kind="verdict", text=text, photos=photos, next_step=step)]


def _parts(report: SceneReport, bridges: Sequence[Bridge], workspace: Workspace) -> list[SceneFinding]:
    """The parts that no verified pair connects with the largest one."""
    findings = []
    for number, part in enumerate(report.components[1:], start=1):
        best = next((bridge for bridge in bridges if bridge.part == number), None)
        text = f"no verified pair connects {len(part)} photos with the {len(report.components[0])} others"
        if best is None:
            step = command_again(workspace, "pairs", "--pairing", "exhaustive")
            text += "; none was matched with one of those"
        else:
            text += f"; nearest: {best.name0} – {best.name1} with {best.num_kept} kept matches"
            if best.num_kept >= _FEWEST_TO_LOWER_FOR:
                fewest = str(max(_FEWEST_TO_LOWER_FOR, best.num_kept * 2 // 3))
                step = command_again(workspace, "pruned matches", "--min-num-inliers", fewest)
            else:
                step = more_photos_to_map(workspace, f"between {best.name0} and {best.name1}")
        text += _why_not_joined(report, set(part))
        findings.append(SceneFinding(kind="parts", text=text, photos=part, next_step=step))
    return findings


def _models(report: SceneReport, workspace: Workspace) -> list[SceneFinding]:
    """Further models, where verified pairs connect them with the first one; else they are parts."""
    findings = []
    first = set(report.models[0].image_names) if report.models else set()
    main = next((set(part) for part in report.components if not first.isdisjoint(part)), set())
    for number, model in enumerate(report.models[1:], start=1):
        names = tuple(name for name in model.image_names if name not in first)
        if names and not main.isdisjoint(names):
            text = (
                f"model {number} holds {len(names)} photos that model 0 does not, though pairs connect them"
            )
            text += _why_not_joined(report, set(names))
            step = more_photos_to_map(workspace, f"that show what both {names[0]} and model 0 see")
            findings.append(SceneFinding(kind="models", text=text, photos=names, next_step=step))
    return findings


def _why_not_joined(report: SceneReport, photos: set[str]) -> str:
    """What the attempt to join a model of these photos with the first one said, if there was one."""
    first = set(report.models[0].image_names) if report.models else set()
    for attempt in report.evidence.get("joinings", ()):
        names0, names1 = set(attempt["photos0"]), set(attempt["photos1"])
        if not attempt["is_joined"] and names0 <= first and not names1.isdisjoint(photos):
            return f"; not joined: {attempt['reason']}"
    return ""


def _missing(report: SceneReport, workspace: Workspace) -> list[SceneFinding]:
    """Photos that no model and no other finding speaks of, by reason."""
    told = {name for part in report.components[1:] for name in part}
    told |= {name for model in report.models for name in model.image_names}
    groups: dict[str, list[MissingPhoto]] = defaultdict(list)
    for photo in report.missing:
        if photo.name not in told and report.models:
            groups[str(photo.reason)].append(photo)
    return [
        SceneFinding(
            kind="missing",
            text=f"{len(photos)} not in the model, {reason}: {photos[0].name}: {photos[0].detail}",
            photos=tuple(photo.name for photo in photos),
            next_step=next_step(photos[0], workspace),
        )
        for reason, photos in groups.items()
    ]


def _weak(held: Sequence[HeldPhoto], workspace: Workspace) -> list[SceneFinding]:
    weak = [photo for photo in held if photo.weakness]
    if not weak:
        return []
    usual = int(np.median([photo.num_points for photo in held]))
    return [
        SceneFinding(
            kind="weak",
            text=f"{len(weak)} of {len(held)} photos weakly held (half of all see {usual} points or more): "
            + first_few(f"{photo.name}: {photo.weakness}" for photo in weak),
            photos=tuple(photo.name for photo in weak),
            next_step=more_photos_to_add(workspace, f"next to {first_few(photo.name for photo in weak)}"),
        )
    ]
