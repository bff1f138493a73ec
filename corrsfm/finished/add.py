"""Photos added to a finished scene, whose model does not move.

The stages do the work, over a list of photos that has grown: each keeps what it has and makes what is new.
Pairs of photos that were there are not chosen again, the database is added to, and the new photos are put
into the models as those are. Each stage's record is what `corrsfm run` would leave, so that a later run with
the same options finds everything up to date.
"""

from __future__ import annotations

import dataclasses
import logging
import shlex
import tempfile
import time
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from corrsfm import config as cfg
from corrsfm.database.stage import fingerprint_of as database_fingerprint
from corrsfm.database.write import add_to_database
from corrsfm.errors import InputError, first_few
from corrsfm.features.stage import extract_features
from corrsfm.files import atomic_write_json, read_json
from corrsfm.finished.advice import next_step
from corrsfm.finished.arrival import (
    Pending,
    copy_photos,
    pending_addition,
    require_folder,
    sort_out,
)
from corrsfm.finished.grown_lists import cameras_of_new, grown_index
from corrsfm.finished.grown_models import ORIGIN, grow_models
from corrsfm.finished.incoming import (
    PhotoPaths,
    find_photos,
    make_readable,
    refuse_imported,
    require_readable,
)
from corrsfm.images.cache import PhotoCache
from corrsfm.images.index import duplicate_images, name_remarks
from corrsfm.images.stage import fingerprint_of as index_fingerprint
from corrsfm.machine import count_threads, find_device
from corrsfm.matches.stage import match_pairs
from corrsfm.pairs.stage import fingerprint_of as pairs_fingerprint
from corrsfm.pairs.strategies import pairs_of_new_photos
from corrsfm.pipeline import check_options
from corrsfm.prune.stage import prune_matches
from corrsfm.report.stage import report, summarise
from corrsfm.report.statistics import SceneReport
from corrsfm.types import Camera, Pair, PairList
from corrsfm.workspace import Workspace
from corrsfm.workspace.last_run import seed_of_last_run
from corrsfm.workspace.lists import Index, read_added, read_index, read_pairs, write_index, write_pairs
from corrsfm.workspace.models import models_of
from corrsfm.workspace.resume import StageOutcome, finish, photos_left_out
from corrsfm.workspace.stores import features_of, pruned_of

__all__ = ["AddResult", "AddedPhoto", "add_photos"]

logger = logging.getLogger("corrsfm")

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class AddedPhoto:
    """What became of a photo.

    Attributes
    ----------
    name : str
    model : int or None
        Number of the model that it joined; None if it joined none.
    num_inliers : int
        Points of the model that agree with its pose.
    median_error_px : float or None
        Their reprojection error before the pose was refined.
    reason, next_step : str
        Why it joined none, and what to try; empty if it did.
    """

    name: str
    model: int | None
    num_inliers: int
    median_error_px: float | None
    reason: str = ""
    next_step: str = ""


@dataclass(frozen=True, kw_only=True)
class AddResult:
    """What an addition did.

    Attributes
    ----------
    photos : tuple of AddedPhoto
        The new photos, sorted by name; of photos that were there already, those that are in no model.
    already_there : tuple of str
        Photos that the scene holds with the same bytes; nothing was done for them.
    num_new_pairs : int
        Pairs that were matched.
    num_new_points : int
    report : SceneReport or None
        As written to `report.json`; None if there was nothing to do.
    """

    photos: tuple[AddedPhoto, ...]
    already_there: tuple[str, ...]
    num_new_pairs: int = 0
    num_new_points: int = 0
    report: SceneReport | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, with the summary of the report."""
        return {
            "photos": [dataclasses.asdict(photo) for photo in self.photos],
            "already_there": list(self.already_there),
            "num_new_pairs": self.num_new_pairs,
            "num_new_points": self.num_new_points,
            "summary": self.report.to_dict()["summary"] if self.report else None,
        }


def add_photos(
    workspace: Path | str,
    photos: PhotoPaths = (),
    *,
    refine: bool = False,
    run: cfg.RunConfig | None = None,
) -> AddResult:
    """Add photos to a finished scene: only what is new is computed, and the model does not move.

    Photos from elsewhere are copied into the folder of the scene's photos, where the next run finds them.
    After an interruption the same call goes on.

    Parameters
    ----------
    workspace : path
    photos : path or sequence of paths
        Photos and folders of photos; may be left out to finish an addition that was interrupted.
    refine : bool
        At the end adjust the whole model: all poses, cameras and points may move a little.
    run : RunConfig, optional
        A seed of 0 stands for that of the scene's last run.

    Returns
    -------
    AddResult

    Raises
    ------
    InputError
        If a photo cannot be read, or its name is that of another photo of the scene. Nothing was changed.
    WorkspaceError
        If the scene has no current model, or another process works there.
    """
    scene = Workspace(Path(workspace))
    with scene.lock(), tempfile.TemporaryDirectory() as scratch:
        run = _with_seed(run or cfg.RunConfig(), scene)
        refuse_imported(scene)
        pending = pending_addition(scene)
        find_device(run.device)
        masks = cfg.from_dict(cfg.ImagesConfig, pending.options["images"], f"{scene.adding}: images").mask_dir
        found = find_photos(photos, scene.images_dir, mask_dir=masks)
        found = make_readable(found, Path(scratch))
        incoming, already = sort_out(found, scene, pending.photos)
        wanted = {**pending.photos, **{photo.name: photo.sha256 for photo in incoming}}
        if not wanted:
            if not already:
                raise InputError(
                    f"{scene.root}: no photos to add were named; try: corrsfm add "
                    f"{shlex.quote(str(scene.root))} NEW"
                )
            summary, _ = summarise(scene)
            unregistered = {photo.name for photo in summary.missing}.intersection(already)
            return AddResult(photos=_outcomes(unregistered, scene, summary), already_there=already)
        require_folder(scene, incoming, wanted)
        require_readable(incoming)
        pending = dataclasses.replace(pending, photos=wanted, refine=refine or pending.refine)
        addition = _Addition(scene, pending, run)
        # Whatever does not fit is refused before anything is changed.
        addition.check_options()
        addition.grown_index({photo.name: photo.file for photo in incoming})
        atomic_write_json(scene.adding, dataclasses.asdict(pending))
        copy_photos(incoming, scene.images_dir)
        return addition.finish(already)


def _with_seed(run: cfg.RunConfig, workspace: Workspace) -> cfg.RunConfig:
    """The seed of the scene's last run if none was asked for, so that its records keep fitting."""
    return dataclasses.replace(run, seed=run.seed or seed_of_last_run(workspace) or 0)


class _Addition:
    """The stages of one addition, each of which does nothing if it is done."""

    def __init__(self, workspace: Workspace, pending: Pending, run: cfg.RunConfig) -> None:
        self._workspace = workspace
        self._hashes = pending.photos
        self._new = sorted(pending.photos)
        self._recorded = pending.options
        self._refine = pending.refine
        self._run = run

    def _options(self, stage: str, options: type[T]) -> T:
        return cfg.from_dict(options, self._recorded[stage], f"{self._workspace.adding}: {stage}")

    def check_options(self) -> None:
        """Check that the networks of the scene are here; raises as `corrsfm.pipeline.check_options`."""
        check_options(
            self._run,
            self._options("pruned matches", cfg.PruneConfig),
            features=self._options("features", cfg.FeaturesConfig),
            matches=self._options("matches", cfg.MatchesConfig),
            workspace_dir=self._workspace.root,
        )

    def finish(self, already: tuple[str, ...]) -> AddResult:
        """Do what is left to do."""
        workspace, run = self._workspace, self._run
        self._say(self._index())
        self._say(extract_features(workspace, self._options("features", cfg.FeaturesConfig), run))
        self._say(self._pairs())
        matched = match_pairs(workspace, self._options("matches", cfg.MatchesConfig), run)
        self._say(matched)
        self._say(prune_matches(workspace, self._options("pruned matches", cfg.PruneConfig), run))
        self._say(self._database())
        num_new_points = self._models()
        summary = report(workspace, html=True)
        workspace.adding.unlink(missing_ok=True)
        return AddResult(
            photos=_outcomes(self._new, workspace, summary),
            already_there=already,
            num_new_pairs=matched.num_items - matched.num_reused,
            num_new_points=num_new_points,
            report=summary,
        )

    @staticmethod
    def _say(outcome: StageOutcome) -> None:
        logger.info("%s", outcome)

    def grown_index(self, paths: Mapping[str, Path]) -> Index:
        """The list of photos with the new ones, which may lie elsewhere still; raises as `grown_index`."""
        workspace = self._workspace
        index, folder = read_index(workspace), workspace.images_dir
        fresh = {name: paths.get(name, folder / name) for name in self._new if name not in index.names}
        config = self._options("images", cfg.ImagesConfig)
        cache = PhotoCache(workspace.photo_cache)
        there = {record.name: record.sha256 for record in index.records}
        there |= {name: cache.hash_of(path) for name, path in fresh.items()}
        if exchanged := [name for name, sha256 in self._hashes.items() if there[name] != sha256]:
            raise InputError(
                f"{folder}: no longer the photos that were to be added: {first_few(exchanged)}; put those "
                "back, or remove what is in their place, and run the same command again"
            )
        return grown_index(index, fresh, folder, config, cache) if fresh else index

    def _index(self) -> StageOutcome:
        """List the new photos, with cameras of photos like them."""
        workspace, started = self._workspace, time.monotonic()
        num_before = len(read_index(workspace).records)
        config = self._options("images", cfg.ImagesConfig)
        grown = self.grown_index({})
        num_fresh = len(grown.records) - num_before
        if num_fresh:
            self._warn_of_names(grown, config)
        # An interruption may have come between the list and its record.
        is_current = workspace.is_current("images", index_fingerprint(grown), workspace.images_json)
        if not is_current:
            # Killed after this, the grown list is not taken for a damaged one; so with the pairs.
            workspace.forget("images")
            write_index(workspace, grown)
        outcome = StageOutcome(
            stage="images",
            num_items=len(grown.records),
            num_reused=num_before,
            seconds=time.monotonic() - started,
            skipped=not num_fresh,
        )
        if not is_current:
            finish(workspace, outcome, index_fingerprint(grown), config)
        return outcome

    def _warn_of_names(self, grown: Index, config: cfg.ImagesConfig) -> None:
        """What other programs, or the next run, would make of the new names."""
        for remark in name_remarks(self._new):
            logger.warning("%s", remark)
        for equal in duplicate_images(grown.records):
            if not set(self._new).isdisjoint(equal):
                logger.warning("photos with the same content: %s", ", ".join(equal))
        if config.image_list is not None:
            logger.warning(
                "the photos of this scene were chosen by --image-list %s: put the new names into it, or the "
                "next run leaves them out",
                config.image_list,
            )
        workspace, given = self._workspace, self._workspace.given_photos
        if workspace.has_own_photos:
            if str(workspace.images_dir.resolve()) not in given:
                logger.warning(
                    "a run of %s leaves the new photos out; to go on with them: %s",
                    first_few(given),
                    workspace.command_for("images", images_dir=str(workspace.images_dir)),
                )
        elif workspace.images_dir.resolve() not in [Path(photos).resolve() for photos in given]:
            logger.warning(
                "this scene was made of %s: name the new photos in %s too, or the next run leaves them out",
                first_few(given),
                workspace.images_dir,
            )

    def _pairs(self) -> StageOutcome:
        """Add the pairs of the new photos to the list."""
        workspace, started = self._workspace, time.monotonic()
        index, features = read_index(workspace), workspace.require("features")
        config = self._options("pairs", cfg.PairsConfig)
        fingerprint = pairs_fingerprint(
            index, features.fingerprint, config, self._run.seed, is_sequence=workspace.is_sequence
        )
        known = read_pairs(workspace)
        if workspace.is_current("pairs", fingerprint, workspace.pairs, workspace.pair_origins):
            return StageOutcome(stage="pairs", num_items=len(known), num_reused=len(known), skipped=True)
        left_out = photos_left_out(workspace, index.names)
        names = [name for name in index.names if name not in left_out]
        with features_of(workspace).reader() as read_features:
            proposed = pairs_of_new_photos(
                names,
                [name for name in self._new if name not in left_out],
                config.num_retrieved,
                load_features=read_features,
                seed=self._run.seed,
            )
        origins: dict[Pair, tuple[str, ...]] = dict(zip(known.pairs, known.origins, strict=True))
        # A user's list may hold a pair the other way round.
        there = {frozenset(pair) for pair in known.pairs}
        origins |= {pair: (ORIGIN,) for pair in proposed if frozenset(pair) not in there}
        pairs = tuple(sorted(origins))
        workspace.forget("pairs")
        write_pairs(workspace, PairList(pairs=pairs, origins=tuple(origins[pair] for pair in pairs)))
        outcome = StageOutcome(
            stage="pairs", num_items=len(pairs), num_reused=len(known), seconds=time.monotonic() - started
        )
        finish(workspace, outcome, fingerprint, config, inputs={"features": features.fingerprint})
        return outcome

    def _database(self) -> StageOutcome:
        """Add the new photos to the database and verify their pairs."""
        workspace, started = self._workspace, time.monotonic()
        config = self._options("verified matches", cfg.DatabaseConfig)
        fingerprint = database_fingerprint(workspace, config, self._run.seed)
        pairs = read_pairs(workspace).pairs
        if workspace.is_current("verified matches", fingerprint, workspace.database):
            return StageOutcome(
                stage="verified matches", num_items=len(pairs), num_reused=len(pairs), skipped=True
            )
        fresh = set(self._new)
        index = read_index(workspace)
        of_new = [pair for pair in pairs if not fresh.isdisjoint(pair)]
        with (
            features_of(workspace).reader() as read_features,
            pruned_of(workspace).reader() as read_pruned,
        ):
            cameras = cameras_of_new(workspace, index, self._new)
            self._remark_on(cameras)
            add_to_database(
                workspace.database,
                images=[record for record in index.records if record.name in fresh],
                cameras=cameras,
                features=read_features,
                kept=((*pair, read_pruned(pair).indices) for pair in of_new),
                config=config,
                seed=self._run.seed,
                num_threads=count_threads(self._run.threads),
                log_file=workspace.log,
            )
        outcome = StageOutcome(
            stage="verified matches",
            num_items=len(pairs),
            num_reused=len(pairs) - len(of_new),
            seconds=time.monotonic() - started,
        )
        inputs = {"pruned matches": workspace.require("pruned matches").fingerprint}
        finish(workspace, outcome, fingerprint, config, inputs=inputs)
        return outcome

    def _remark_on(self, cameras: Mapping[str, tuple[int, Camera]]) -> None:
        """Put into `cameras.json` who of the new photos shares a camera of the model."""
        path, model = self._workspace.cameras_json, models_of(self._workspace)[0]
        try:
            remarks = list(read_json(path)["remarks"])
        except (OSError, ValueError, KeyError, TypeError):
            remarks = []
        shared = [name for name, (number, _) in cameras.items() if number in model.cameras]
        own = [name for name in cameras if name not in shared]
        for names, camera in ((shared, "the camera of photos like them"), (own, "cameras of their own")):
            remark = f"added with {camera}: {first_few(names)}"
            if names and remark not in remarks:
                remarks.append(remark)
        atomic_write_json(path, {"remarks": remarks})

    def _models(self) -> int:
        """Put the new photos into the models; the number of new points."""
        config = self._options("models", cfg.ReconstructionConfig)
        outcome, num_new_points = grow_models(
            self._workspace, self._new, config, self._run, refine=self._refine
        )
        self._say(outcome)
        return num_new_points


def _outcomes(names: Collection[str], workspace: Workspace, summary: SceneReport) -> tuple[AddedPhoto, ...]:
    """What became of each photo, with a reason and a next step where it joined no model."""
    added = read_added(workspace)
    missing = {photo.name: photo for photo in summary.missing}
    outcomes = []
    for name in sorted(names):
        entry = added.get(name, {})
        lost = entry.get("model") is None and name in missing
        reason = ""
        if lost:
            photo = missing[name]
            reason = entry.get("why_not") or f"{photo.reason}: {photo.detail}"
        outcomes.append(
            AddedPhoto(
                name=name,
                model=entry.get("model"),
                num_inliers=entry.get("num_inliers", 0),
                median_error_px=entry.get("median_error_px"),
                reason=reason,
                next_step=next_step(missing[name], workspace) if lost else "",
            )
        )
    return tuple(outcomes)
