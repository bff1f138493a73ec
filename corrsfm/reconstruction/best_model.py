"""The model of a scene: mapped, judged, and chosen among candidates where the first one does not convince."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from corrsfm.reconstruction.budget import TimeBudget
from corrsfm.reconstruction.calibration import (
    DEFAULT_REFINEMENT,
    Refinement,
    describe_impossible,
    has_prior_focal_lengths,
)
from corrsfm.reconstruction.candidates import (
    Candidate,
    MapperKind,
    StartingCameras,
    candidate_bank,
    has_unknown_focal_lengths,
)
from corrsfm.reconstruction.choice import Choice, ChoicePolicy, Tried, choose_model
from corrsfm.reconstruction.explained import explain
from corrsfm.reconstruction.focal_slack import measure_focal_slack
from corrsfm.reconstruction.folds.evidence import FoldEvidence
from corrsfm.reconstruction.folds.unfold import Attempt, judge_model
from corrsfm.reconstruction.lens import measure_lens_misfit
from corrsfm.reconstruction.mending import Mender
from corrsfm.reconstruction.pool import CandidatePool
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.reconstruction.unfolding import unfold_model
from corrsfm.reconstruction.verdict import Evidence, Verdict, judge, thickness
from corrsfm.reconstruction.views import views_of
from corrsfm.types import Pair

__all__ = ["Selection", "judge_as_it_is", "select_model"]

FIRST = "first"
_MENDED = "+mended"
# Of the time for other models, for those without some pairs. The rest is for candidates.
_SHARE_TO_UNFOLD = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Selection:
    """The model that was selected, and why.

    Attributes
    ----------
    model : pycolmap.Reconstruction
    choice : Choice
    verdict : Verdict
    folds : FoldEvidence
        Of the selected model, counted on all verified matches.
    left_out : tuple of Pair
        Verified pairs that were left out to unfold the model, sorted; mostly none.
    cameras : StartingCameras
        What it was mapped with.
    """

    model: pycolmap.Reconstruction
    choice: Choice
    verdict: Verdict
    folds: FoldEvidence
    left_out: tuple[Pair, ...] = ()
    cameras: StartingCameras = StartingCameras.AS_IS


def select_model(
    first: pycolmap.Reconstruction | None,
    evidence: SceneEvidence,
    database: Path,
    workdir: Path,
    *,
    policy: ChoicePolicy,
    first_seconds: float,
    seed: int = 0,
    cameras_on_trial: StartingCameras | None = None,
    refinement: Refinement = DEFAULT_REFINEMENT,
    num_processes: int = 1,
    unfold: bool = True,
) -> Selection | None:
    """Keep the first model if it convinces, else try candidates and take the one that predicts most matches.

    A first model that is folded by repeated structure is unfolded instead, if that explains enough: a fold
    predicts and explains as much as a right model.

    Parameters
    ----------
    first : pycolmap.Reconstruction or None
        The model that mapping gave; None if it gave none, and the first candidate that gives one stands in.
    evidence : SceneEvidence
    database : Path
        That the first model was made from; not changed.
    workdir : Path
        Candidates are kept here and read again after an interruption, so it must be of this database and
        these options alone; the caller removes it once the choice is safe.
    policy : ChoicePolicy
    first_seconds : float
        What mapping the first model took.
    seed : int
        Of the first model.
    cameras_on_trial : StartingCameras, optional
        Other cameras to try as well, see `corrsfm.reconstruction.candidates.find_cameras_on_trial`.
    refinement : Refinement
        The same for every candidate as for the first model.
    num_processes : int
        Candidates mapped at a time; the choice does not depend on it.
    unfold : bool
        Try to unfold a folded model.

    Returns
    -------
    Selection or None
        None if nothing gave a model.

    Raises
    ------
    DatabaseError
        If the database cannot be read.
    """
    models: dict[str, pycolmap.Reconstruction] = {}
    left_out: dict[str, tuple[Pair, ...]] = {}
    taken_apart: set[str] = set()

    def tried(
        name: str,
        model: pycolmap.Reconstruction,
        seconds: float,
        *,
        way: str = MapperKind.INCREMENTAL,
        has_more_cameras: bool = False,
    ) -> Tried:
        models[name] = model
        views = views_of(model)
        return Tried(
            name=name,
            way=way,
            views=views,
            explained=evidence.explain(views),
            seconds=seconds,
            has_more_cameras=has_more_cameras,
        )

    def has_more_cameras(cameras: StartingCameras) -> bool:
        others_share = cameras_on_trial is StartingCameras.SHARED
        return cameras is StartingCameras.SEPARATE or (others_share and cameras is not cameras_on_trial)

    bank = candidate_bank(
        seed=seed,
        on_trial=cameras_on_trial,
        calibrate=has_unknown_focal_lengths(database),
        refinement=refinement,
    )
    cameras_of = {candidate.name: candidate.cameras for candidate in bank}
    budget = TimeBudget(policy.max_time_factor * first_seconds + 1)
    with CandidatePool(database, workdir, refinement=refinement, num_processes=num_processes) as pool:

        def map_round(candidates: Sequence[Candidate]) -> list[Tried | None]:
            with budget.spent():
                found = pool.map(candidates, max_runtime_seconds=max(budget.seconds_left, 1))
            return [
                None
                if model is None
                else tried(
                    one.name,
                    model,
                    pool.seconds(one),
                    way=one.mapper,
                    has_more_cameras=has_more_cameras(one.cameras),
                )
                for one, model in zip(candidates, found, strict=True)
            ]

        mender = Mender(evidence, database, workdir / "again", seed=seed, refinement=refinement)

        def mend(model: Tried, *, parts_only: bool = False) -> Tried | None:
            cameras = cameras_of.get(model.name, StartingCameras.AS_IS)
            ways = [] if model.name in taken_apart else [mender.put_parts]
            taken_apart.add(model.name)
            for way in ways if parts_only else [*ways, mender.register_misplaced]:
                left = budget.seconds_left
                if not left:
                    return None
                with budget.spent() as spent:
                    again = way(
                        models[model.name], model.explained, cameras=cameras, max_runtime_seconds=left
                    )
                if again is not None:
                    break
            else:
                return None
            name = model.name + _MENDED
            while name in models:
                name += _MENDED
            # It may have more to mend.
            cameras_of[name], left_out[name] = cameras, left_out.get(model.name, ())
            outcome = tried(name, again, spent(), way=model.way, has_more_cameras=model.has_more_cameras)
            put = way == mender.put_parts or model.is_put_together
            return dataclasses.replace(outcome, is_open=model.is_open, is_put_together=put)

        start, others = None, []
        if first is not None:
            start = tried(FIRST, first, first_seconds)
            # With a camera for each photo a wrong model explains nearly everything, too. Photos of many
            # sizes, as from many people, are mapped again only if their focal lengths are open.
            if cameras_on_trial is StartingCameras.SHARED:
                is_open = _are_mostly_of_one_size(first) or _has_large_slack(first)
                start = dataclasses.replace(start, is_open=is_open, has_more_cameras=True)
        while start is None and bank and policy.max_models > 1:
            candidates, bank = bank[: policy.round_size], bank[policy.round_size :]
            others = map_round(candidates)
            start = next((outcome for outcome in others if outcome is not None), None)
            others = [outcome for outcome in others if outcome is not start]
        if start is None:
            return None
        mended = mend(start, parts_only=True) if policy.max_models > 1 else None
        whole = mended is not None and mended.num_registered >= start.num_registered
        judged = mended if mended is not None and whole else start
        attempt = judge_model(models[judged.name], evidence.verified)
        if unfold:
            with budget.spent() as spent:
                part = TimeBudget(_SHARE_TO_UNFOLD * budget.seconds_left)
                best = unfold_model(attempt, evidence, database, workdir, seed, refinement, part)
            if best is not attempt:
                unfolded = _tried_unfolded(best, evidence, spent())
                if unfolded.explained.explains_enough:
                    known = (one for one in (start, mended, *others) if one is not None)
                    return _selection_of(best, unfolded, tuple(known), len(evidence.names))
                # Whatever the first model was, it was more than a fold.
                unfolded = dataclasses.replace(
                    unfolded, has_more_cameras=has_more_cameras(StartingCameras.AS_IS)
                )
                others = [*others, unfolded]
                models[unfolded.name], left_out[unfolded.name] = best.model, best.removed
        choice = choose_model(
            start,
            bank,
            mended=mended,
            others=others,
            num_photos=len(evidence.names),
            map_round=map_round,
            count_predicted=evidence.count_predicted,
            policy=policy,
            mend=mend,
        )
    model = models[choice.chosen.name]
    if choice.chosen.name != judged.name:
        attempt = judge_model(model, evidence.verified)
    return Selection(
        model=model,
        choice=choice,
        verdict=_verdict(model, choice, len(evidence.names), attempt.evidence),
        folds=attempt.evidence,
        left_out=left_out.get(choice.chosen.name, ()),
        cameras=cameras_of.get(choice.chosen.name, StartingCameras.AS_IS),
    )


def _has_large_slack(model: pycolmap.Reconstruction) -> bool:
    slack = measure_focal_slack(model)
    return slack is not None and slack.is_large


def _are_mostly_of_one_size(model: pycolmap.Reconstruction) -> bool:
    """Whether half of the photos of a model, or more, have one size and no known focal length."""
    cameras = [image.camera for image in model.images.values() if image.has_pose]
    sizes = Counter((one.width, one.height) for one in cameras if not one.has_prior_focal_length)
    return 2 * max(sizes.values(), default=0) >= len(cameras)


def _tried_unfolded(attempt: Attempt, evidence: SceneEvidence, seconds: float) -> Tried:
    """An unfolded model; what it explains is counted without the pairs left out."""
    views = views_of(attempt.model)
    left_out = set(attempt.removed)
    verified = {pair: matches for pair, matches in evidence.verified.items() if pair not in left_out}
    return Tried(
        name="-".join(["unfolded", *attempt.rules]),
        way=MapperKind.INCREMENTAL,
        views=views,
        explained=explain(views, evidence.keypoints, verified),
        seconds=seconds,
    )


def _selection_of(attempt: Attempt, unfolded: Tried, known: tuple[Tried, ...], num_photos: int) -> Selection:
    """An unfolded model as the selection."""
    choice = Choice(
        chosen=unfolded,
        tried=(*known, unfolded),
        reason="the first model was folded by repeated structure",
    )
    return Selection(
        model=attempt.model,
        choice=choice,
        verdict=_verdict(attempt.model, choice, num_photos, attempt.evidence),
        folds=attempt.evidence,
        left_out=attempt.removed,
    )


def judge_as_it_is(
    model: pycolmap.Reconstruction, evidence: SceneEvidence, *, name: str, reason: str
) -> Selection:
    """The verdict on a model without looking for a better one.

    Parameters
    ----------
    model : pycolmap.Reconstruction
    evidence : SceneEvidence
    name, reason : str
        What to call it in the record, and why nothing else was tried.
    """
    views = views_of(model)
    chosen = Tried(
        name=name,
        way=MapperKind.INCREMENTAL,
        views=views,
        explained=evidence.explain(views),
        seconds=0.0,
    )
    choice = Choice(chosen=chosen, tried=(chosen,), reason=reason)
    folds = judge_model(model, evidence.verified).evidence
    return Selection(
        model=model,
        choice=choice,
        verdict=_verdict(model, choice, len(evidence.names), folds),
        folds=folds,
    )


def _verdict(model: pycolmap.Reconstruction, choice: Choice, num_photos: int, folds: FoldEvidence) -> Verdict:
    points = np.array([point.xyz for point in model.points3D.values()], np.float64).reshape(-1, 3)
    return judge(
        Evidence(
            num_photos=num_photos,
            explained=choice.chosen.explained,
            support=choice.support,
            could_try_more=choice.could_try_more,
            implausible_intrinsics=describe_impossible(model),
            has_prior_focal_lengths=has_prior_focal_lengths(model),
            focal_slack=measure_focal_slack(model),
            lens_misfit=measure_lens_misfit(model),
            thickness=thickness(points),
            is_folded=folds.folded,
            conflicts=[f"{pair.name0} – {pair.name1}" for pair in folds.worst(3)] if folds.folded else (),
        )
    )
