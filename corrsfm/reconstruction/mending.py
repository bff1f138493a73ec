"""A model with a part or photos in the wrong place, mended."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from corrsfm.reconstruction.budget import TimeBudget
from corrsfm.reconstruction.calibration import DEFAULT_REFINEMENT, Refinement
from corrsfm.reconstruction.candidates import StartingCameras
from corrsfm.reconstruction.explained import Explained
from corrsfm.reconstruction.parts import put_together_again
from corrsfm.reconstruction.registration import register_again
from corrsfm.reconstruction.scene_evidence import SceneEvidence

__all__ = ["Mender"]


class Mender:
    """Mends models of one scene.

    Parameters
    ----------
    evidence : SceneEvidence
    database : Path
        The verified matches that the models were made from; not changed.
    workdir : Path
        Made when it is needed, and removed.
    seed : int
    refinement : Refinement
        What may change of the cameras.
    """

    def __init__(
        self,
        evidence: SceneEvidence,
        database: Path,
        workdir: Path,
        *,
        seed: int = 0,
        refinement: Refinement = DEFAULT_REFINEMENT,
    ) -> None:
        self._evidence = evidence
        self._database = database
        self._workdir = workdir
        self._seed = seed
        self._refinement = refinement

    def put_parts(
        self,
        model: pycolmap.Reconstruction,
        explained: Explained,
        *,
        cameras: StartingCameras = StartingCameras.AS_IS,
        max_runtime_seconds: int = 0,
    ) -> pycolmap.Reconstruction | None:
        """Put parts where most points say, and register what hung by even less than they.

        Parameters
        ----------
        model : pycolmap.Reconstruction
            Not changed.
        explained : Explained
            What it explains.
        cameras : StartingCameras
            What it was mapped with in place of the cameras of the database.
        max_runtime_seconds : int
            0 for no limit.

        Returns
        -------
        pycolmap.Reconstruction or None
            None if there is no part to put, or no better place.

        Raises
        ------
        DatabaseError
            If the database cannot be read.
        """
        budget = TimeBudget(max_runtime_seconds)
        with budget.spent():
            again = put_together_again(
                model,
                explained,
                self._database,
                self._evidence,
                seed=self._seed,
                refinement=self._refinement,
                max_runtime_seconds=max_runtime_seconds,
            )
        if again is None or again.num_reg_images() >= model.num_reg_images():
            return again
        if max_runtime_seconds and not budget.seconds_left:
            return again
        return self._register(again, (), cameras, budget.seconds_left) or again

    def register_misplaced(
        self,
        model: pycolmap.Reconstruction,
        explained: Explained,
        *,
        cameras: StartingCameras = StartingCameras.AS_IS,
        max_runtime_seconds: int = 0,
    ) -> pycolmap.Reconstruction | None:
        """Register misplaced photos again, see `put_parts`; None if there are none, or that gave nothing."""
        if not explained.misplaced:
            return None
        return self._register(model, explained.misplaced, cameras, max_runtime_seconds)

    def _register(
        self,
        model: pycolmap.Reconstruction,
        names: tuple[str, ...],
        cameras: StartingCameras,
        max_runtime_seconds: int,
    ) -> pycolmap.Reconstruction | None:
        return register_again(
            model,
            names,
            self._database,
            self._workdir,
            cameras=cameras,
            seed=self._seed,
            refinement=self._refinement,
            max_runtime_seconds=max_runtime_seconds,
        )
