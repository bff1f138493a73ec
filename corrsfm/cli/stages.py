"""The commands that are the steps of a reconstruction, and the one that runs them all."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from corrsfm import config as cfg
from corrsfm.cli.options import (
    PATH,
    WARNED_KEY,
    config_options,
    echo_json,
    json_option,
    overwrite_option,
    pipeline_options,
    resuming_run_options,
    run_options,
)
from corrsfm.cli.sections import SectionedCommand
from corrsfm.errors import ReconstructionError
from corrsfm.export import ExportTarget

if TYPE_CHECKING:
    from corrsfm.report import SceneReport
    from corrsfm.workspace.resume import StageOutcome

__all__ = ["extract", "match", "pairs", "prune", "reconstruct", "report", "run"]

PHOTOS = click.argument("photos", metavar="PHOTOS...", nargs=-1, required=True, type=PATH)
WORKSPACE = click.argument("workspace_dir", metavar="WORKSPACE", type=PATH)


def _show(outcomes: Sequence[StageOutcome], as_json: bool) -> None:
    """The outcomes of some stages, for a person or a machine."""
    if as_json:
        echo_json([outcome.__dict__ for outcome in outcomes])
        return
    for outcome in outcomes:
        click.echo(str(outcome))


def _step(
    function: Callable, workspace_dir: Path, config: object, run: cfg.RunConfig, overwrite: bool
) -> StageOutcome:
    from corrsfm.workspace import Workspace

    workspace = Workspace(workspace_dir)
    with workspace.lock():
        return function(workspace, config, run, overwrite=overwrite)


@click.command(cls=SectionedCommand, most_used=("max_features", "camera_mode", "pairing"))
@PHOTOS
@WORKSPACE
@config_options(
    images=cfg.ImagesConfig, features=cfg.FeaturesConfig, pairs=cfg.PairsConfig, matches=cfg.MatchesConfig
)
@resuming_run_options
@overwrite_option
@json_option
def extract(
    photos: tuple[Path, ...],
    workspace_dir: Path,
    images: cfg.ImagesConfig,
    features: cfg.FeaturesConfig,
    pairs: cfg.PairsConfig,
    matches: cfg.MatchesConfig,
    run: cfg.RunConfig,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Index photos, extract features, match.

    PHOTOS is a folder, a video, or any of several folders, photos, lists of photos (.txt) and quoted
    patterns. Lists the photos and their cameras, extracts SIFT features or those of a network, chooses pairs
    and finds the nearest neighbour of every keypoint, with its distance ratio and a mutual flag.
    """
    from corrsfm import pipeline
    from corrsfm.cluster import connected
    from corrsfm.images.sources import whole_folder
    from corrsfm.workspace import Workspace

    pipeline.check_options(run, features=features, matches=matches, workspace_dir=workspace_dir)
    workspace = Workspace(workspace_dir, create=True, images_dir=whole_folder(photos))
    with workspace.lock(), connected(run.cluster, run.workers):
        outcomes = [
            pipeline.index_photos(workspace, photos, images, run, overwrite=overwrite),
            pipeline.extract_features(workspace, features, run, overwrite=overwrite),
            pipeline.make_pairs(workspace, pairs, run, overwrite=overwrite),
            pipeline.match_pairs(workspace, matches, run, overwrite=overwrite),
        ]
    _show(outcomes, as_json)


@click.command(cls=SectionedCommand)
@WORKSPACE
@config_options(config=cfg.PairsConfig)
@run_options
@overwrite_option
@json_option
def pairs(
    workspace_dir: Path, config: cfg.PairsConfig, run: cfg.RunConfig, overwrite: bool, as_json: bool
) -> None:
    """Choose again which photos are matched."""
    from corrsfm.pairs.stage import make_pairs

    _show([_step(make_pairs, workspace_dir, config, run, overwrite)], as_json)


@click.command(cls=SectionedCommand)
@WORKSPACE
@config_options(config=cfg.MatchesConfig)
@resuming_run_options
@overwrite_option
@json_option
def match(
    workspace_dir: Path, config: cfg.MatchesConfig, run: cfg.RunConfig, overwrite: bool, as_json: bool
) -> None:
    """Match the chosen pairs again.

    Finds the nearest neighbour of every keypoint, with its distance ratio and a mutual flag.
    """
    from corrsfm.matches.stage import match_pairs

    _show([_step(match_pairs, workspace_dir, config, run, overwrite)], as_json)


@click.command(cls=SectionedCommand)
@WORKSPACE
@config_options(config=cfg.PruneConfig, database=cfg.DatabaseConfig)
@resuming_run_options
@overwrite_option
@json_option
def prune(
    workspace_dir: Path,
    config: cfg.PruneConfig,
    database: cfg.DatabaseConfig,
    run: cfg.RunConfig,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Prune matches and write the database.

    Writes the kept matches to a COLMAP database and verifies them geometrically.
    """
    from corrsfm.database.stage import verify_matches
    from corrsfm.prune.stage import prune_matches

    outcomes = [
        _step(prune_matches, workspace_dir, config, run, overwrite),
        _step(verify_matches, workspace_dir, database, run, overwrite),
    ]
    _show(outcomes, as_json)


@click.command(cls=SectionedCommand)
@WORKSPACE
@config_options(config=cfg.ReconstructionConfig)
@run_options
@overwrite_option
@json_option
def reconstruct(
    workspace_dir: Path, config: cfg.ReconstructionConfig, run: cfg.RunConfig, overwrite: bool, as_json: bool
) -> None:
    """Map the verified matches into models.

    Writes COLMAP models, the largest at sparse/0, and prints the statistics.
    """
    from corrsfm.reconstruction.stage import reconstruct as map_verified

    try:
        _step(map_verified, workspace_dir, config, run, overwrite)
    except ReconstructionError as error:
        command = shlex.join(["corrsfm", "report", str(workspace_dir)])
        raise ReconstructionError(f"{error}\nevery photo and pair: {command}") from error
    _print_report(workspace_dir, as_json)


@click.command()
@WORKSPACE
@json_option
def report(workspace_dir: Path, as_json: bool) -> None:
    """Print the statistics and write the page.

    Writes report.json and report.html, a self-contained page.
    """
    _print_report(workspace_dir, as_json, html=True)


@click.command(
    cls=SectionedCommand,
    most_used=("method", "max_features", "camera_mode", "pairing", "file"),
    epilog="The other headings are the tables of a pipeline file: --max-ratio is max_ratio in [prune].",
)
@PHOTOS
@WORKSPACE
@pipeline_options
@click.option("--wait", is_flag=True, help="Wait for another corrsfm that works in the workspace.")
@overwrite_option
@json_option
def run(
    photos: tuple[Path, ...],
    workspace_dir: Path,
    config: cfg.PipelineConfig,
    overwrite: bool,
    wait: bool,
    as_json: bool,
) -> None:
    """Do everything, from photos to a report.

    PHOTOS is a folder, a video, or any of several folders, photos, lists of photos (.txt) and quoted
    patterns. They stay as they are; everything made goes into the folder WORKSPACE. Finished work is kept:
    after an interruption or a changed option, run the same command again.
    """
    from corrsfm.pipeline import run_scene

    warned = click.get_current_context().meta.get(WARNED_KEY, [])
    result = run_scene(photos, workspace_dir, config, overwrite=overwrite, wait=wait, warned=warned)
    _show_report(result, as_json, workspace_dir)


def _print_report(workspace_dir: Path, as_json: bool, *, html: bool = False) -> None:
    """Gather and show the statistics; report.json is written always, report.html if asked for."""
    from corrsfm.report.stage import report as summarise
    from corrsfm.workspace import Workspace

    workspace = Workspace(workspace_dir)
    with workspace.lock():
        result = summarise(workspace, html=html)
    _show_report(result, as_json, workspace_dir if html else None)


def _show_report(report: SceneReport, as_json: bool, workspace_dir: Path | None) -> None:
    """Show the statistics and, of a workspace whose page was written, where to go on."""
    from corrsfm.report import format_table

    if as_json:
        echo_json(report.to_dict())
        return
    click.echo(format_table(report))
    if workspace_dir is None:
        return
    click.echo(f"\nreport: {workspace_dir / 'report.html'}")
    if report.models:
        export = shlex.join(["corrsfm", "export", str(workspace_dir), "OUT", "--for", "nerfstudio"])
        click.echo(f"next:   {export}, or another of: {', '.join(ExportTarget)}")
