"""The seventh stage: the verified pairs of the database become models."""

from __future__ import annotations

import functools
import logging
import shlex
import shutil
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from corrsfm import config as cfg
from corrsfm.colmap.log import pycolmap_version
from corrsfm.colmap.pairs import names_of_verified_pairs, read_verified_matches
from corrsfm.config import config_hash
from corrsfm.disk import is_closed, opening
from corrsfm.errors import CorrsfmError, InputError, ReconstructionError, first_few
from corrsfm.files import atomic_write_json, remove
from corrsfm.graph import connected_components
from corrsfm.images.photos import stored_size
from corrsfm.machine import count_threads
from corrsfm.reconstruction.best_model import judge_as_it_is, select_model
from corrsfm.reconstruction.budget import policy_for
from corrsfm.reconstruction.calibration import Refinement
from corrsfm.reconstruction.candidates import StartingCameras, find_cameras_on_trial
from corrsfm.reconstruction.joining import join_models
from corrsfm.reconstruction.mapper import reconstruct as map_database
from corrsfm.reconstruction.mapper import threads_for
from corrsfm.reconstruction.record import record_of
from corrsfm.reconstruction.scene_evidence import SceneEvidence
from corrsfm.types import Features
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import Index, read_added, read_index
from corrsfm.workspace.models import copy_aside, others_in_models
from corrsfm.workspace.resume import StageOutcome, explain, finish, require_database
from corrsfm.workspace.stores import features_of
from corrsfm.workspace.warned import keeps_warnings

if TYPE_CHECKING:
    import pycolmap

__all__ = ["fingerprint_of", "reconstruct"]

logger = logging.getLogger("corrsfm")


@keeps_warnings("models")
def reconstruct(
    workspace: Workspace, config: cfg.ReconstructionConfig, run: cfg.RunConfig, *, overwrite: bool = False
) -> StageOutcome:
    """Map the verified database into models, the largest at `sparse/0`.

    Raises
    ------
    ReconstructionError
        If no model came out, with the reason; models of earlier matches are then in ``sparse.old``.
    """
    started = time.monotonic()
    verified = require_database(workspace)
    fingerprint = fingerprint_of(verified.fingerprint, config, run.seed)
    # Models without colours are remade once the photos are back.
    black = config_hash("black", fingerprint)
    index = read_index(workspace)
    images_dir, why_black = _photos_for_colours(workspace, index)
    current = [fingerprint] if images_dir else [fingerprint, black]
    if not overwrite and any(workspace.is_current("models", one, workspace.sparse / "0") for one in current):
        num = sum(1 for path in workspace.sparse.iterdir() if path.is_dir())
        if added := read_added(workspace):
            logger.info("models: photos added to them without mapping again are kept: %d", len(added))
        return StageOutcome(stage="models", num_items=num, num_reused=num, skipped=True)
    explain(workspace, "models", config)
    _keep_models(workspace)
    names = index.names
    if images_dir is None:
        fingerprint = black
        logger.warning("%s", why_black)
    _warn_of_parts(workspace, names)
    chooses = config.mapper is cfg.Mapper.INCREMENTAL and config.max_models_tried > 1
    features = features_of(workspace)
    with (
        features.reader() if chooses or config.join_models else nullcontext(_no_features) as load,
        tqdm(total=len(names), desc="mapping", unit="photo", leave=False) as bar,
    ):
        choice = _Choice(workspace, names, load, config, run, workspace.candidates / fingerprint[:16])
        try:
            models = map_database(
                workspace.database,
                images_dir,
                workspace.sparse,
                config=config,
                seed=run.seed,
                num_threads=count_threads(run.threads),
                log_file=workspace.log,
                on_progress=functools.partial(_show_progress, bar),
                choose=choice if chooses else None,
                join=choice.join if config.join_models else None,
                before_replacing=lambda: _replace_evidence(workspace, choice.record),
            )
        except ReconstructionError:
            workspace.put_models_aside()
            raise
    for path in (workspace.added, workspace.adding):
        path.unlink(missing_ok=True)
    outcome = StageOutcome(stage="models", num_items=len(models), seconds=time.monotonic() - started)
    finish(workspace, outcome, fingerprint, config, inputs={"verified matches": verified.fingerprint})
    return outcome


def fingerprint_of(verified: str, config: cfg.ReconstructionConfig, seed: int) -> str:
    """What the record of the stage must carry to be current; ``verified`` is that of the verified matches."""
    return config_hash("models", pycolmap_version(), verified, config, seed)


def _photos_for_colours(workspace: Workspace, index: Index) -> tuple[Path | None, str]:
    """The folder that points get their colours from; None, and why, if pycolmap would stumble there.

    Raises
    ------
    InputError
        If photos may not be read.
    """
    folder = workspace.images_dir
    for path in (folder, *(folder / name for name in index.names)):
        if is_closed(path):
            raise InputError(opening(path))
    if not folder.is_dir():
        command = workspace.command_for("images", images_dir="NEWDIR")
        return None, f"photos are no longer at {folder}; the points stay black; if they moved, run: {command}"
    for record in index.records:
        path, camera = folder / record.name, index.camera_of(record)
        try:
            size = stored_size(path) if path.exists() else None
        except InputError as error:
            return None, f"the points stay black; {error}"
        if size is not None and size != (camera.width, camera.height):
            again = workspace.command_for("images")
            return None, f"the points stay black; {path}: is of another size than it was; run: {again}"
    return folder, ""


def _replace_evidence(workspace: Workspace, record: dict[str, Any] | None) -> None:
    """Just before new models take the place of the old: until here, on a full disk say, those stay in use."""
    if record is None:
        workspace.forget("models")
        workspace.evidence.unlink(missing_ok=True)
    else:
        atomic_write_json(workspace.evidence, record, before_replacing=lambda: workspace.forget("models"))


def _keep_models(workspace: Workspace) -> None:
    """Before all is mapped again: keep a copy of what that cannot make again, and say so."""
    if workspace.adding.exists():
        logger.warning(
            "an addition of photos was not finished; all photos are mapped again instead, and every pose "
            "moves; to finish it instead, stop and run: corrsfm add %s",
            shlex.quote(str(workspace.root)),
        )
    added = read_added(workspace)
    others = others_in_models(workspace)
    kept = "there are no models to keep"
    if workspace.sparse.is_dir() and (added or others):
        kept = f"the models so far are kept in {copy_aside(workspace)}"
    if others and not added:
        logger.warning("not as corrsfm wrote it: %s; %s", first_few(map(str, others)), kept)
    if not added:
        return
    logger.warning(
        "photos added to the models without moving the others: %d (%s); all photos are mapped again "
        "now and every pose moves; %s",
        len(added),
        first_few(added),
        kept,
    )


class _Choice:
    """Chooses the first model with what the workspace knows; keeps the record of it."""

    def __init__(
        self,
        workspace: Workspace,
        names: list[str],
        load: Callable[[str], Features],
        config: cfg.ReconstructionConfig,
        run: cfg.RunConfig,
        workdir: Path,
    ) -> None:
        self._workspace = workspace
        self._names = names
        self._load = load
        self._config = config
        self._run = run
        self._workdir = workdir
        self.record: dict[str, Any] | None = None

    def __call__(
        self, first: pycolmap.Reconstruction | None, seconds: float
    ) -> pycolmap.Reconstruction | None:
        workspace, run = self._workspace, self._run
        # Drop candidates that were mapped from other matches or options.
        for folder in workspace.candidates.glob("*"):
            if folder != self._workdir:
                remove(folder)
        try:
            selection = select_model(
                first,
                self._evidence,
                workspace.database,
                self._workdir,
                policy=policy_for(self._config.max_models_tried, seconds),
                first_seconds=seconds,
                seed=run.seed,
                cameras_on_trial=self._cameras_on_trial(),
                refinement=Refinement.of(self._config),
                num_processes=count_threads(run.threads),
                unfold=self._config.unfold,
            )
        except (OSError, CorrsfmError):
            # They must not hold on to what little space there is; only kills leave them, to go on from.
            shutil.rmtree(workspace.candidates, ignore_errors=True)
            raise
        self.record = None if selection is None else record_of(selection, self._evidence)
        if workspace.candidates.is_dir():
            shutil.rmtree(workspace.candidates)
        if selection is None:
            return None
        choice = selection.choice
        if selection.left_out:
            logger.info("unfolded: %d pairs of look-alike places were left out", len(selection.left_out))
        if len(choice.tried) > 1:
            logger.info(
                "models tried: %d (%s); chosen: %s", len(choice.tried), choice.reason, choice.chosen.name
            )
        logger.info("verdict: %s", selection.verdict)
        return selection.model

    @functools.cached_property
    def _evidence(self) -> SceneEvidence:
        verified = read_verified_matches(self._workspace.database)
        return SceneEvidence(self._names, verified, self._load, seed=self._run.seed)

    def join(self, models: list[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
        """Join what can be joined of several models; what was tried goes into the record."""
        left, attempts = join_models(
            models,
            self._workspace.database,
            self._evidence,
            seed=self._run.seed,
            refinement=Refinement.of(self._config),
            num_threads=threads_for(len(self._names), count_threads(self._run.threads)),
        )
        for attempt in attempts:
            logger.info("%s", attempt)
        if left[0] is not models[0]:
            selection = judge_as_it_is(
                left[0], self._evidence, name="joined", reason="models of parts of the scene were joined"
            )
            self.record = record_of(selection, self._evidence)
            logger.info("verdict: %s", selection.verdict)
        self.record = {**(self.record or {}), "joinings": [attempt.to_dict() for attempt in attempts]}
        return left

    def _cameras_on_trial(self) -> StartingCameras | None:
        """Other cameras to try; none where the user said which photos share one."""
        if self._workspace.require("images").config["camera_mode"] != cfg.CameraMode.AUTO:
            return None
        return find_cameras_on_trial(self._workspace.database)


def _no_features(photo: str) -> Features:
    raise AssertionError(f"the features of {photo} are needed by the choice of a model only")


def _show_progress(bar: tqdm, num_registered: int) -> None:
    # A new model, or a new attempt at the same one, begins.
    if num_registered < bar.n:
        bar.reset()
    bar.n = num_registered
    bar.refresh()


def _warn_of_parts(workspace: Workspace, names: list[str]) -> None:
    """Warn before mapping if the verified pairs do not connect the photos."""
    parts = [
        part
        for part in connected_components(names, names_of_verified_pairs(workspace.database))
        if len(part) > 1
    ]
    if len(parts) > 1:
        logger.warning(
            "verified pairs fall into %d components of %s photos: each becomes a separate model at best; "
            "add photos that bridge them, or try more features or more pairs\n"
            "not connected to the largest: %s",
            len(parts),
            first_few(str(len(part)) for part in parts),
            first_few(name for part in parts[1:] for name in part),
        )
