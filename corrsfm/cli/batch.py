"""The command for many scenes."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import click

from corrsfm.cli.options import OVERWRITE_KEY, PATH, echo_json, json_option
from corrsfm.errors import first_few

__all__ = ["batch"]


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("collection", type=PATH)
@click.argument("output", type=PATH)
@click.argument("run_arguments", nargs=-1, type=click.UNPROCESSED)
@click.option(
    "--jobs",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Scenes at a time; they share the cores, unless --threads says otherwise.",
)
@click.option("--dask", metavar="ADDRESS", help="Dask scheduler whose workers run the scenes instead.")
@json_option
def batch(
    collection: Path, output: Path, run_arguments: tuple[str, ...], jobs: int, dask: str | None, as_json: bool
) -> None:
    """Run every scene of a COLLECTION into OUTPUT/<scene>.

    A scene is a sub-folder with photos, or with a folder `images` of photos. All further arguments go to
    `corrsfm run`. One scene's failure does not stop the others; run it again to go on. A folder without
    photos is passed over.
    """
    from corrsfm.batch import run_collection

    _check_arguments(run_arguments)
    click.get_current_context().meta[OVERWRITE_KEY] = "--overwrite" in run_arguments
    if dask is not None:
        run_arguments = _with_absolute_paths(run_arguments)
    statuses = run_collection(collection, output, run_arguments, jobs=jobs, dask=dask)
    if as_json:
        echo_json([status.__dict__ for status in statuses])
    else:
        for status in statuses:
            click.echo(str(status))
    failed = sum(status.failed for status in statuses)
    if failed:
        raise click.ClickException(
            f"{failed} of {len(statuses)} scenes failed; see {output}/<scene>.batch.log"
        )
    if all(status.empty for status in statuses):
        raise click.ClickException(f"{collection}: no photos in any of {len(statuses)} folders")


def _with_absolute_paths(run_arguments: tuple[str, ...]) -> tuple[str, ...]:
    """Name files as a worker, whose current folder is another, finds them; names of what is no file stay."""
    from corrsfm.cli.stages import run

    of_files = {flag for option in run.params if option.type is PATH for flag in option.opts}
    absolute = []
    for before, argument in itertools.pairwise(["", *run_arguments]):
        flag, is_joined, value = argument.partition("=")
        if before in of_files and os.path.exists(argument):
            absolute.append(os.path.abspath(argument))
        elif is_joined and flag in of_files and os.path.exists(value):
            absolute.append(f"{flag}={os.path.abspath(value)}")
        else:
            absolute.append(argument)
    return tuple(absolute)


def _check_arguments(run_arguments: tuple[str, ...]) -> None:
    """Refuse once what `corrsfm run` would refuse for every scene, and words that it takes for folders."""
    from corrsfm.cli.stages import run
    from corrsfm.config import load_pipeline

    folders = ["PHOTOS", "WORKSPACE"]
    with run.make_context("corrsfm run", [*folders, *run_arguments]) as context:
        given = [str(path) for path in (*context.params["photos"], context.params["workspace_dir"])]
        pipeline = context.params["file"]
    if stray := given[len(folders) :]:
        raise click.UsageError(
            f"{first_few(stray)}: expected options of corrsfm run after the collection and the output"
        )
    if pipeline:
        load_pipeline(pipeline)
