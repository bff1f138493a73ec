"""The commands for a finished scene: photos that join it, photos that are located in it."""

from __future__ import annotations

from pathlib import Path

import click

from corrsfm import config as cfg
from corrsfm.cli.options import CSV_FILE, PATH, echo_json, json_option, run_options
from corrsfm.errors import first_few, printable

__all__ = ["add", "localize", "show_workspace"]


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


@click.command()
@click.argument("workspace_dir", metavar="WORKSPACE", type=PATH)
@click.argument("photos", metavar="QUERY", nargs=-1, required=True, type=PATH)
@click.option("--csv", "csv_file", type=CSV_FILE, help="Also write the poses to this file, a line a photo.")
@click.option(
    "--camera-params",
    default="",
    help="Known intrinsics of all these photos, comma-separated in COLMAP's order; otherwise the camera that "
    "the scene's photos of this kind share, EXIF, or what is found with the pose.",
)
@click.option(
    "--camera-model", default="", help="COLMAP model of --camera-params; that of the scene if not given."
)
@run_options
@json_option
def localize(
    workspace_dir: Path,
    photos: tuple[Path, ...],
    csv_file: Path | None,
    camera_params: str,
    camera_model: str,
    run: cfg.RunConfig,
    as_json: bool,
) -> None:
    """Find where photos were taken in a finished scene.

    QUERY are photos and folders of photos. They do not join the scene, and the workspace is not changed.
    Prints the centre of each camera in the frame of the model; --json and --csv have the poses. Ends with
    code 1 if a photo could not be located.
    """
    from corrsfm.finished.localize import localize as locate

    result = locate(workspace_dir, photos, camera_params=camera_params, camera_model=camera_model, run=run)
    if csv_file is not None:
        result.write_csv(csv_file)
    if as_json:
        echo_json(result.to_dict())
    else:
        width = max(len(photo.name) for photo in result.photos)
        for photo in result.photos:
            if photo.centre is None:
                click.echo(f"{photo.name:<{width}}  not located: {photo.why_not}")
                continue
            x, y, z = photo.centre
            click.echo(
                f"{photo.name:<{width}}  centre {x:9.4f} {y:9.4f} {z:9.4f}   {photo.num_inliers} of "
                f"{photo.num_candidates} points agree, {photo.median_error_px:.2f} px"
                + (f", in model {photo.model}" if photo.model else "")
            )
        click.echo(f"{result.num_located} of {len(result.photos)} photos located")
    if result.num_located < len(result.photos):
        raise click.exceptions.Exit(1)


def show_workspace(workspace_dir: Path, as_json: bool, integrity: bool) -> None:
    """What `corrsfm check` prints of a workspace; raises Exit if its model is not fit to be used."""
    from corrsfm.finished.check import check_workspace

    result = check_workspace(workspace_dir, integrity=integrity)
    if as_json:
        echo_json(result.to_dict())
    else:
        if result.num_photos:
            click.echo(f"{workspace_dir}: {result.num_registered} of {result.num_photos} photos registered")
        if result.verdict:
            click.echo(f"verdict: {result.verdict}")
        weak = [photo for photo in result.photos if photo.weakness]
        if weak:
            width = max(len(photo.name) for photo in weak)
            click.echo(f"{'weakly held':<{width}}  pairs  points")
            for photo in weak:
                click.echo(
                    f"{photo.name:<{width}}  {photo.num_pairs:>5}  {photo.num_points:>6}  {photo.weakness}"
                )
        if len(result.parts) > 1:
            sizes = ", ".join(str(len(part)) for part in result.parts)
            click.echo(f"parts of the pair graph: {sizes} photos; pairs that come nearest to bridging them:")
            for bridge in result.bridges:
                kept = f"{bridge.num_kept} of {bridge.num_putative} matches kept"
                click.echo(f"  {bridge.name0} – {bridge.name1}: {kept}")
        for lost in result.missing:
            click.echo(f"missing: {lost.name}: {lost.reason}: {lost.detail}")
        for number, finding in enumerate(result.findings, start=1):
            click.echo(printable(f"{number}. {finding.text}\n   next: {finding.next_step}"))
        if not result.findings:
            click.echo("nothing to object to")
    if not result.is_usable:
        raise click.exceptions.Exit(1)
