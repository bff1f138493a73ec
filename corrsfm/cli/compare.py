"""The command that compares prune methods by whole reconstructions."""

from __future__ import annotations

import functools
from pathlib import Path

import click
from click.core import ParameterSource

from corrsfm.cli.evaluate import command_line
from corrsfm.cli.options import (
    PATH,
    RESULT_FILE,
    echo_json,
    json_option,
    overwrite_option,
    pipeline_options,
    seeds_option,
)
from corrsfm.cli.sections import SectionedCommand
from corrsfm.config import PipelineConfig

__all__ = ["compare"]


@click.command(
    cls=SectionedCommand,
    most_used=("methods", "num_seeds", "output", "ground_truth", "max_features", "file"),
)
@click.argument("images_dir", metavar="IMAGES", type=PATH)
@click.option(
    "--methods",
    default="ratio,loransac,magsac,corradaptor,cascade",
    show_default=True,
    help="Prune methods with commas between; each METHOD[@sfm|@pose][:CHECKPOINT].",
)
@click.option(
    "--output",
    type=PATH,
    help="Folder for workspaces, compare.json and compare.html. [default: compare_IMAGES]",
)
@click.option("--ground-truth", type=PATH, help="COLMAP model or folder of camera files to measure against.")
@click.option("--results", type=RESULT_FILE, help="Also write the result file here.")
@seeds_option
@functools.partial(pipeline_options, several_methods=True)
@overwrite_option
@json_option
def compare(
    images_dir: Path,
    methods: str,
    output: Path | None,
    ground_truth: Path | None,
    results: Path | None,
    num_seeds: int,
    config: PipelineConfig,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare prune methods on the same photos.

    Features and matches are computed once, models once for every method and seed. The table, median (worst)
    over the seeds, goes to standard output, the page with the pairs that differ most to OUTPUT/compare.html.
    """
    source = click.get_current_context().get_parameter_source("method")
    if source is ParameterSource.COMMANDLINE:
        raise click.UsageError("--method chooses one method; name those to compare with --methods")
    from corrsfm.evaluation.scenes.compare import compare_methods
    from corrsfm.evaluation.tables import render_table

    output = output or Path(f"compare_{images_dir.resolve().name}")
    values = compare_methods(
        images_dir,
        output,
        [method.strip() for method in methods.split(",")],
        config,
        num_seeds=num_seeds,
        ground_truth=ground_truth,
        results=results,
        overwrite=overwrite,
        command=command_line(),
    )
    if as_json:
        echo_json(values)
    else:
        click.echo(render_table({"kind": "compare", **values}))
        click.echo(f"\npage: {output / 'compare.html'}")
