"""Commands that train the network: pairs from photos, the run, the checkpoint, pictures of all of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from corrsfm.cli.options import (
    CHECKPOINT_FILE,
    PAIR_FILE,
    PATH,
    PNG_FILE,
    RESUME_KEY,
    config_options,
    recipe_options,
    usage_options,
)
from corrsfm.training.config import PrepareConfig

if TYPE_CHECKING:
    from collections.abc import Callable

    from corrsfm.config import NetworkUsage
    from corrsfm.training.config import TrainRecipe

__all__ = ["train"]

_NUM_COMPARED_BATCHES = 8


@click.group()
def train() -> None:
    """Train the pruning network."""


@train.command()
@click.argument("scenes", nargs=-1, required=True, type=PATH)
@click.option("--output", required=True, type=PAIR_FILE, help="File of labelled pairs to write.")
@click.option(
    "--splits", type=PATH, help="JSON with scene names by split; SCENES is then the folder that holds them."
)
@click.option("--split", default="train", show_default=True, help="Which split of --splits.")
@click.option(
    "--layout",
    type=click.Choice(["compact", "oanet"]),
    default="compact",
    show_default=True,
    help="compact keeps keypoints once per photo; oanet is what the published training codes read.",
)
@config_options(prepare_config=PrepareConfig)
def prepare(
    scenes: tuple[Path, ...],
    output: Path,
    splits: Path | None,
    split: str,
    layout: str,
    prepare_config: PrepareConfig,
) -> None:
    """Turn photo scenes with cameras into labelled pairs.

    Each of SCENES is a folder with images/ and a COLMAP model (beside it, in sparse/0 or in model).
    """
    from corrsfm.training.prepare import prepare_file, prepare_oanet, scenes_of_split

    folders = scenes_of_split(scenes[0], splits, split) if splits else list(scenes)
    write = prepare_oanet if layout == "oanet" else prepare_file
    for name, num_pairs in write(output, folders, prepare_config):
        click.echo(f"{name}\t{num_pairs}")


@train.command()
@recipe_options
@click.option("--resume", is_flag=True, help="Continue the run in the output folder, if there is one.")
@click.option("--device", default="auto", show_default=True, help="auto, cpu, cuda or cuda:N.")
@click.option(
    "--threads",
    type=click.IntRange(0, 1024),
    default=0,
    show_default=True,
    help="Threads to use; 0 for all cores.",
)
def run(recipe: TrainRecipe, resume: bool, device: str, threads: int) -> None:
    """Train by a recipe, alone or on several GPUs under torchrun."""
    if not recipe.train.train_files:
        raise click.UsageError("no pairs to train on; give --train-files, or --config with train_files")
    from corrsfm.machine import count_threads, find_device, use_threads
    from corrsfm.training.loop import train as train_by_recipe

    click.get_current_context().meta[RESUME_KEY] = resume
    use_threads(count_threads(threads))
    path = train_by_recipe(recipe, device=find_device(device), resume=resume, on_log=_echo_row)
    click.echo(str(path))


def _echo_row(row: dict[str, Any]) -> None:
    values = (
        f"{name} {value:.5g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in row.items()
    )
    click.echo("  ".join(values), err=True)


@train.command()
@click.argument("source", metavar="RUN", type=PATH)
@click.argument("output", type=CHECKPOINT_FILE)
@click.option("--half/--no-half", default=True, show_default=True, help="Store in half precision.")
@usage_options
def export(source: Path, output: Path, half: bool, adjust: Callable[[NetworkUsage], NetworkUsage]) -> None:
    """Write the averaged weights of RUN as a checkpoint for `corrsfm prune`.

    RUN may also be a checkpoint, of this project or published, that lacks a property: what it reads and its
    operating points stay as they are but for the flags given here; the defaults are those of a checkpoint
    that says nothing.
    """
    from corrsfm.errors import InputError
    from corrsfm.model import load_network, read_provenance, save_network

    checkpoint = source / "latest.pt" if source.is_dir() else source
    # One that comes with corrsfm has no path.
    if output.exists() and checkpoint.exists() and output.samefile(checkpoint):
        raise InputError(f"{output}: is what is exported; choose another name")
    network = load_network(checkpoint)
    network.usage = adjust(network.usage)
    digest = save_network(network, output, provenance=read_provenance(checkpoint), half=half)
    click.echo(f"{output}  sha256 {digest}")


@train.command()
@click.option("--run", "run_folder", type=PATH, help="Run folder, for its learning curves.")
@click.option(
    "--pairs", "pair_files", multiple=True, type=PATH, help="Pair files to compare with synthetic pairs."
)
@click.option("--output", required=True, type=PNG_FILE, help="PNG to write.")
def plots(run_folder: Path | None, pair_files: tuple[Path, ...], output: Path) -> None:
    """Draw the learning curves of a run, or a page that compares real and synthetic pairs."""
    if (run_folder is None) == (not pair_files):
        raise click.UsageError("give either --run or --pairs")
    from corrsfm.training import plots as pictures

    if run_folder is not None:
        pictures.plot_learning_curves(run_folder, output)
    else:
        from corrsfm.training.synthetic import draw_both

        pictures.plot_distributions(*draw_both(pair_files, _NUM_COMPARED_BATCHES), output)
    click.echo(str(output))
