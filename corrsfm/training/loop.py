"""The training loop: draw a batch, step, average; log, validate and save from time to time.

With ``torchrun`` every process trains on its own device and its own batches, gradients are averaged, and
process 0 writes. In a run bounded by time the share of the time used drives the schedule, so that the
learning rate reaches zero when the time is up. A run folder holds ``recipe.json`` (options, seed, versions),
``log.csv``, ``validation.csv``, ``state.pt`` (everything that resuming needs) and ``latest.pt`` (averaged
weights).
"""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any, cast

import torch
from torch import Tensor, nn

from corrsfm.config import MatchInput, to_dict
from corrsfm.errors import ConfigError
from corrsfm.labelled.compact import read_scenes
from corrsfm.model import CorrAdaptor, Rival, RivalConfig, build_network, save_network
from corrsfm.prune.correspondences import missing_channels
from corrsfm.training.checkpoint import Average, damaged_state, load_state, save_state
from corrsfm.training.config import TrainRecipe
from corrsfm.training.dataset import Batch, RealPairs, concatenate, generator_for, side_information
from corrsfm.training.initial import initial_network
from corrsfm.training.journal import Journal, described_recipe, hardware, make_output
from corrsfm.training.objectives import objective
from corrsfm.training.schedule import learning_rate_factor
from corrsfm.training.synthetic import SyntheticPairs
from corrsfm.training.validation import Validation
from corrsfm.workspace.lease import hold

__all__ = ["Trainer", "train"]

logger = logging.getLogger(__name__)


def train(
    recipe: TrainRecipe,
    *,
    device: str | torch.device,
    resume: bool = False,
    on_log: Callable[[dict[str, Any]], None] | None = None,
) -> Path:
    """Run a recipe to its end.

    Parameters
    ----------
    recipe : TrainRecipe
    device : str or torch.device
        Replaced by the process's own GPU under ``torchrun``.
    resume : bool
        Continue the run in the output folder, if there is one.
    on_log : callable, optional
        Called with every line of the log.

    Returns
    -------
    Path
        The averaged weights.

    Raises
    ------
    ConfigError
        If synthetic pairs are wanted for a network that reads mutual matches only; if the network reads side
        channels that the pairs lack; if the output folder holds a run already and ``resume`` is not set.
    """
    if recipe.train.input is MatchInput.MUTUAL and recipe.train.synthetic_share > 0:
        raise ConfigError(
            "synthetic pairs hold all nearest neighbours; set synthetic_share to 0 for input mutual"
        )
    options = recipe.train
    # If it is unusable, now and not after hours.
    if options.val_file is not None:
        read_scenes(options.val_file)
    with _process_group(torch.device(device)) as (rank, own_device), ExitStack() as stack:
        data = RealPairs.from_files(
            options.train_files,
            own_device,
            scene_power=options.scene_power,
            match_input=options.input,
            negative_share=options.negative_share,
        )
        if rank == 0:
            stack.enter_context(_held(options.output))
        trainer = Trainer(recipe, data, own_device, rank=rank, on_log=on_log)
        channels = trainer.network.side_channels
        if missing := missing_channels(channels, has_shapes=data.has_shapes, has_ratios=True):
            raise ConfigError(
                f"network: its {channels} side channels read {missing}, which these pairs lack; set "
                "side_channels = 2"
            )
        if trainer.state_path.exists():
            if not resume:
                raise ConfigError(
                    f"{recipe.train.output}: holds a run already; try --resume or another --output"
                )
            trainer.load()
        elif (weights := recipe.train.output / "latest.pt").exists():
            raise ConfigError(
                f"{weights}: weights of a run whose state.pt is gone, so it cannot go on; choose another "
                "--output, and --initial to begin from them"
            )
        return trainer.run()


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Hold the folder of a run for this process, and refuse one with weights that no run left there."""
    weights = folder / "latest.pt"
    if weights.exists() and not (folder / "recipe.json").exists():
        raise ConfigError(f"{weights}: is of no run in this folder; move it away, or choose another --output")
    make_output(folder)
    with hold(folder / ".lock"):
        yield


@contextmanager
def _process_group(device: torch.device) -> Iterator[tuple[int, torch.device]]:
    """Rank and device of this process; joins the processes that ``torchrun`` started."""
    if "RANK" not in os.environ:
        yield 0, device
        return
    backend = "nccl" if device.type == "cuda" else "gloo"
    torch.distributed.init_process_group(backend)
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(device)
    try:
        yield torch.distributed.get_rank(), device
    finally:
        torch.distributed.destroy_process_group()


class Trainer:
    """One run: network, optimiser, average, and the folder they are saved to.

    Parameters
    ----------
    recipe : TrainRecipe
    data : RealPairs
    device : torch.device
    rank : int
        Number of this process; process 0 writes.
    on_log : callable, optional
    """

    def __init__(
        self,
        recipe: TrainRecipe,
        data: RealPairs,
        device: torch.device,
        *,
        rank: int = 0,
        on_log: Callable[[dict[str, Any]], None] | None = None,
    ) -> None:
        self.recipe, self.config, self.data, self.device, self.rank = recipe, recipe.train, data, device, rank
        torch.manual_seed(self.config.seed)
        self.network = initial_network(recipe).to(device)
        shape = self.network.config
        self.architecture = shape.architecture if isinstance(shape, RivalConfig) else "corradaptor"
        self._synthetic = SyntheticPairs(recipe.synthetic, device)
        self.average = Average(self.network, self.config.ema_decay)
        self.optimiser = torch.optim.AdamW(
            _parameter_groups(self.network, self.config.weight_decay), lr=self.config.learning_rate
        )
        self._model: nn.Module = self.network
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            self._model = nn.parallel.DistributedDataParallel(self.network, find_unused_parameters=True)
        if self.config.compile:
            self._model = cast(nn.Module, torch.compile(self._model))
        self.step = self.num_skipped = 0
        self.minutes = 0.0
        # Options that were others before a step, when the run went on with a changed recipe.
        self.changes: list[dict[str, Any]] = []
        self._validation: Validation | None = None
        self._journal = Journal(self.config.output, tensorboard=self.config.tensorboard, on_row=on_log)
        self.state_path = self.config.output / "state.pt"

    @property
    def progress(self) -> float:
        """Share of the run that is done, in [0, 1]."""
        if self.config.max_minutes > 0:
            return min(self.minutes / self.config.max_minutes, 1.0)
        return min(self.step / self.config.max_steps, 1.0)

    def run(self) -> Path:
        """Train to the end; returns the path of the averaged weights."""
        if self.rank == 0:
            self._journal.write_recipe(self._provenance())
        clock = time.process_time if self.config.processor_time else time.monotonic
        started = clock() - 60.0 * self.minutes
        last = {"log": self.minutes, "save": self.minutes, "validate": self.minutes}
        since: dict[str, list[float]] = {}
        while (progress := self._agreed_progress()) < 1.0:
            losses = self.train_step(progress)
            self.minutes = (clock() - started) / 60.0
            for name, value in losses.items():
                since.setdefault(name, []).append(value)
            # Steps may be slow: log at least once a minute.
            if self.step % self.config.log_every == 0 or self.minutes - last["log"] >= 1.0:
                # Steps that were skipped, or lack a term, have no part in its mean.
                self._log({name: fmean(values) for name, values in since.items()}, progress)
                since = {}
                last["log"] = self.minutes
            if self.rank == 0 and self.minutes - last["save"] >= self.config.checkpoint_minutes:
                self.save()
                last["save"] = self.minutes
            if self.rank == 0 and self.minutes - last["validate"] >= self.config.validate_minutes:
                self.validate()
                last["validate"] = self.minutes
        if self.rank == 0:
            self.save()
            self.validate()
        return self.config.output / "latest.pt"

    def _agreed_progress(self) -> float:
        """Progress of process 0: clocks differ, but all processes must stop at the same step."""
        if self._model is self.network or not torch.distributed.is_initialized():
            return self.progress
        shared = torch.tensor([self.progress], dtype=torch.float64, device=self.device)
        torch.distributed.broadcast(shared, 0)
        return float(shared)

    def train_step(self, progress: float) -> dict[str, float]:
        """Take one step; returns its losses, or nothing if it was skipped."""
        config = self.config
        rate = config.learning_rate * learning_rate_factor(progress, config.warm_up, config.schedule)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        batch = self.draw(self.step)
        self._model.train()
        self.optimiser.zero_grad(set_to_none=True)
        loss, parts = self.loss(batch, with_essential=progress >= config.essential_start)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), config.max_gradient_norm)
        self.step += 1
        if not bool(torch.isfinite(norm)):
            self.num_skipped += 1
            return {}
        self.optimiser.step()
        self.average.update(self.network)
        return {"loss": float(loss.detach()), **parts, "gradient": float(norm)}

    def draw(self, step: int) -> Batch:
        """The batch of a step, a function of seed, step and rank only."""
        config = self.config
        num_synthetic = round(config.synthetic_share * config.batch_size)
        num_real = config.batch_size - num_synthetic
        parts = []
        if num_real > 0:
            generator = generator_for(config.seed, step, self.rank, self.device)
            parts.append(self.data.sample(num_real, config.num_matches, self.recipe.augment, generator))
        if num_synthetic > 0:
            generator = generator_for(config.seed, step, self.rank, self.device, stream=1)
            num_matches = parts[0].mask.shape[1] if parts else config.num_matches
            parts.append(self._synthetic.sample(num_synthetic, num_matches, generator))
        return concatenate(parts)

    def loss(self, batch: Batch, *, with_essential: bool) -> tuple[Tensor, dict[str, float]]:
        """The network's published loss of a batch, and its parts."""
        mask = None if bool(batch.mask.all()) else batch.mask
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.bfloat16):
            output = self._model(
                batch.correspondences, side_information(batch, self.network.side_channels), mask
            )
        terms = objective(
            self.architecture,
            output,
            batch.distances(),
            mask,
            threshold=self.config.threshold,
            related=batch.related,
            matrix=batch.matrix if with_essential else None,
        )
        total = terms["classification"]
        if "essential" in terms:
            total = total + self.config.essential_weight * terms["essential"]
        return total, {name: float(term.detach()) for name, term in terms.items()}

    def save(self) -> None:
        """Write the state of the run and the averaged weights."""
        save_state(
            self.state_path,
            step=self.step,
            minutes=self.minutes,
            num_skipped=self.num_skipped,
            network=self.network.state_dict(),
            average=self.average.state_dict(),
            optimiser=self.optimiser.state_dict(),
            random=torch.get_rng_state(),
            network_config=json.dumps(to_dict(self.network.config)),
            input=str(self.config.input),
            options=json.dumps(self._options()),
            changes=json.dumps(self.changes),
        )
        save_network(self._averaged(), self.config.output / "latest.pt", provenance=self._provenance())

    def load(self) -> None:
        """Continue from the last state in the run's folder."""
        state = load_state(self.state_path, self.device)
        try:
            self._continue(state)
        except torch.OutOfMemoryError:
            raise
        except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise damaged_state(self.state_path) from error

    def _continue(self, state: dict[str, Any]) -> None:
        if state["network_config"] != json.dumps(to_dict(self.network.config)):
            raise ConfigError(
                f"{self.state_path}: belongs to another network; use another --output or the same recipe"
            )
        if (began := state.get("input", MatchInput.ALL)) != self.config.input:
            raise ConfigError(
                f"{self.state_path}: the run began with input {began}, not {self.config.input}; "
                "use another --output or the same recipe"
            )
        if not all(_are_finite(state[name]) for name in ("network", "average", "optimiser")):
            raise ValueError("holds numbers that are not finite")
        if type(state["step"]) is not int or state["step"] < 0 or not math.isfinite(state["minutes"]):
            raise ValueError("counts no steps")
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimiser.load_state_dict(state["optimiser"])
        torch.set_rng_state(state["random"].cpu())
        self.step, self.minutes, self.num_skipped = state["step"], state["minutes"], state["num_skipped"]
        self.changes = json.loads(state.get("changes", "[]"))
        options = self._options()
        before = json.loads(state["options"]) if "options" in state else options
        if changed := [name for name in options if before.get(name) != options[name]]:
            logger.warning(
                "%s: the run goes on with another recipe from step %d: %s",
                self.config.output,
                self.step,
                ", ".join(f"{name} {before.get(name)} → {options[name]}" for name in changed),
            )
            old = {name: before.get(name) for name in changed}
            self.changes.append({"before_step": self.step, "options": old})

    def _options(self) -> dict[str, Any]:
        """The options that decide about the weights, by table and name; files by name only."""
        tables = described_recipe(self.recipe, only_result=True)
        return {
            f"{table}.{name}": value
            for table, options in tables.items()
            for name, value in options.items()
            if name not in ("output", "val_file")
        }

    def validate(self) -> dict[str, Any] | None:
        """Score the averaged weights on the validation pairs, and append a row to ``validation.csv``."""
        if self.config.val_file is None:
            return None
        if self._validation is None:
            self._validation = Validation(self.config.val_file, self.config.val_pairs_per_scene)
            logger.info("ratio + mutual + LO-RANSAC: AUC@5 %.2f", self._validation.baseline["auc5"])
        result = self._validation.run(self._averaged(), self.device)
        row = {"step": self.step, "minutes": round(self.minutes, 2)}
        row |= {
            name: round(result[name], 3) for name in ("auc5", "auc10", "auc20", "precision", "recall", "f")
        }
        row["baseline_auc5"] = round(self._validation.baseline["auc5"], 3)
        row |= {f"auc5_{scene}": round(value, 3) for scene, value in result["by_scene"].items()}
        self._journal.append("validation", row)
        return result

    def _averaged(self) -> CorrAdaptor | Rival:
        assert self.network.config is not None
        network = build_network(self.network.config).to(self.device)
        network.usage = self.network.usage
        if self.config.ema_decay > 0:
            self.average.copy_to(network)
        else:
            network.load_state_dict(self.network.state_dict())
        return network.eval()

    def _log(self, losses: dict[str, float], progress: float) -> None:
        if self.rank != 0:
            return
        row: dict[str, Any] = {
            "step": self.step,
            "minutes": round(self.minutes, 3),
            "progress": round(progress, 5),
        }
        row["learning_rate"] = self.optimiser.param_groups[0]["lr"]
        row |= {
            name: losses.get(name, float("nan"))
            for name in ("loss", "classification", "essential", "gradient")
        }
        row["skipped"] = self.num_skipped
        self._journal.append("log", row)

    def _provenance(self) -> dict[str, Any]:
        return {
            "scenes": list(self.data.scene_names),
            "num_pairs": self.data.num_pairs,
            "steps": self.step,
            "minutes": round(self.minutes, 1),
            "seed": self.config.seed,
            "recipe": described_recipe(self.recipe),
            **({"changes": self.changes} if self.changes else {}),
            **hardware(self.device),
        }


def _are_finite(values: Any) -> bool:
    """Whether all tensors in nested values are finite."""
    if isinstance(values, Mapping):
        return all(map(_are_finite, values.values()))
    if isinstance(values, list | tuple):
        return all(map(_are_finite, values))
    return not isinstance(values, Tensor) or bool(values.isfinite().all())


def _parameter_groups(network: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """Parameter groups of the optimiser: matrices decay, biases and scales do not."""
    trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
    return [
        {"params": [parameter for parameter in trained if parameter.ndim > 1], "weight_decay": weight_decay},
        {"params": [parameter for parameter in trained if parameter.ndim <= 1], "weight_decay": 0.0},
    ]
