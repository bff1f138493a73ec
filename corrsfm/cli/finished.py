"""The commands for a finished scene: photos that join it, photos that are located in it."""

from __future__ import annotations

from pathlib import Path

import click

from corrsfm import config as cfg
from corrsfm.cli.options import echo_json, json_option, run_options
from corrsfm.errors import first_few

__all__ = ["add"]

PATH = click.Path(path_type=Path)


@click.command()
@click.argument("workspace_dir", metavar="WORKSPACE", type=PATH)
@click.argument("photos", metavar="NEWPHOTOS", nargs=-1, type=PATH)
@click.option(
    "--refine", is_flag=True, help="Adjust the whole model at the end; all poses may move a little."
)
@run_options
@json_option
def add(
    workspace_dir: Path, photos: tuple[Path, ...], refine: bool, run: cfg.RunConfig, as_json: bool
) -> None:
    """Add photos to a finished scene.

    NEWPHOTOS are photos and folders of photos. Only what is new is computed, with the options of the scene,
    and the model stays where it is: no pose and no camera of it changes. Photos from elsewhere are copied
    into the folder of the scene's photos. After an interruption run the same command again. Ends with code 1
    if a photo could not be registered.
    """
    from corrsfm.finished.add import add_photos

    result = add_photos(workspace_dir, photos, refine=refine, run=run)
    failed = [photo for photo in result.photos if photo.model is None]
    if as_json:
        echo_json(result.to_dict())
    else:
        if result.already_there:
            click.echo(f"already there: {first_few(result.already_there)}")
        for photo in result.photos:
            if photo.model is not None:
                fit = f", {photo.median_error_px:.2f} px" if photo.median_error_px is not None else ""
                click.echo(f"{photo.name}: joined model {photo.model} by {photo.num_inliers} points{fit}")
        for photo in failed:
            click.echo(f"{photo.name}: not registered: {photo.reason}\n  next: {photo.next_step}")
        if result.report is not None:
            summary = result.report
            click.echo(
                f"{len(result.photos) - len(failed)} of {len(result.photos)} new photos registered, "
                f"{result.num_new_pairs} pairs matched, {result.num_new_points} new points; now "
                f"{summary.num_registered} of {len(summary.image_names)} photos"
            )
            if summary.verdict:
                click.echo(f"verdict: {summary.verdict}")
            click.echo(f"report: {workspace_dir / 'report.html'}")
        elif not result.photos:
            click.echo("nothing to do")
    if failed:
        raise click.exceptions.Exit(1)
