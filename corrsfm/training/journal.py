"""Recipe and logs of a run: ``recipe.json``, the CSV files, TensorBoard's files."""

from __future__ import annotations

import csv
import json
import math
import platform
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from corrsfm.config import to_dict
from corrsfm.errors import ConfigError, DependencyError
from corrsfm.machine import versions
from corrsfm.training.config import TrainRecipe

__all__ = ["Journal", "described_recipe", "hardware", "make_output"]


def make_output(folder: Path) -> None:
    """Make the folder of a run, if it is missing.

    Raises
    ------
    ConfigError
        If it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made ({error.strerror}); choose another --output") from error


class Journal:
    """Writes the recipe and the logs of a run.

    Parameters
    ----------
    folder : Path
        Folder of the run; made if missing.
    tensorboard : bool
        Log to TensorBoard as well.
    on_row : callable, optional
        Called with every row of every log.
    """

    def __init__(
        self, folder: Path, *, tensorboard: bool, on_row: Callable[[dict[str, Any]], None] | None = None
    ) -> None:
        make_output(folder)
        self._folder, self._tensorboard, self._on_row = folder, tensorboard, on_row
        self._writer: Any = None

    def write_recipe(self, provenance: dict[str, Any]) -> None:
        """Write ``recipe.json``: options, seed, versions."""
        (self._folder / "recipe.json").write_text(
            json.dumps(provenance, indent=1, default=str) + "\n", encoding="utf-8"
        )

    def append(self, name: str, row: dict[str, Any]) -> None:
        """Append a row, with its ``step``, to ``NAME.csv``.

        Raises
        ------
        DependencyError
            If TensorBoard is wanted and not installed.
        """
        path = self._folder / f"{name}.csv"
        new = not path.exists()
        with path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, row)
            if new:
                writer.writeheader()
            writer.writerow(row)
        if self._tensorboard:
            self._add_scalars(name, row)
        if self._on_row:
            self._on_row(row)

    def _add_scalars(self, name: str, row: dict[str, Any]) -> None:
        if self._writer is None:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError as error:
                raise DependencyError("tensorboard", "--tensorboard", "train") from error
            self._writer = SummaryWriter(str(self._folder))
        for key, value in row.items():
            if key != "step" and math.isfinite(value):
                self._writer.add_scalar(f"{name}/{key}", value, row["step"])


def described_recipe(recipe: TrainRecipe, *, only_result: bool = False) -> dict[str, Any]:
    """Recipe in plain values. Files by name only: checkpoints are published, paths are private.

    With ``only_result`` without options of speed and of what is logged.
    """
    values = json.loads(json.dumps(to_dict(recipe, only_result=only_result), default=str))
    train = recipe.train
    values["train"]["train_files"] = [path.name for path in train.train_files]
    values["train"]["output"] = train.output.name
    values["train"]["initial"] = Path(train.initial).name
    if train.val_file is not None:
        values["train"]["val_file"] = train.val_file.name
    return values


def hardware(device: torch.device) -> dict[str, Any]:
    """Device and library versions that a run uses."""
    return {
        "hardware": f"{device.type}, {platform.machine()}, {torch.get_num_threads()} threads",
        "versions": versions(("torch", "numpy")),
    }
