"""The command that looks at photos before a run."""

from __future__ import annotations

import logging
import os
import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import click

from corrsfm.cli.finished import show_workspace
from corrsfm.cli.options import PATH, echo_json, json_option
from corrsfm.errors import CorrsfmError, InputError, first_few

__all__ = ["check"]

logger = logging.getLogger("corrsfm")


@click.command()
@click.argument("photos", metavar="PHOTOS...|WORKSPACE", nargs=-1, required=True, type=PATH)
@click.option(
    "--keep",
    type=PATH,
    help="Write the names of the photos to keep here, for --image-list: all but unreadable, blurred and"
    " doubled ones.",
)
@click.option("--mask-dir", type=PATH, help="Folder of masks, to be looked at too.")
@click.option(
    "--forecast/--no-forecast",
    default=True,
    show_default=True,
    help="Run the first stages on a few photos, about ten seconds, to tell minutes and disk of a run.",
)
@click.option(
    "--integrity/--no-integrity",
    default=True,
    show_default=True,
    help="Of a workspace, read every item of every file.",
)
@click.option(
    "--threads", type=click.IntRange(0, 1024), default=0, help="Photos read at a time; 0 is all cores."
)
@json_option
def check(
    photos: tuple[Path, ...],
    keep: Path | None,
    mask_dir: Path | None,
    forecast: bool,
    integrity: bool,
    threads: int,
    as_json: bool,
) -> None:
    """Look at photos before a run, or at a scene after it.

    Of photos: finds those that cannot be read, that are blurred, that show the same from the same place, or
    whose exposure is far from that of the others, and masks that do not fit, and says what is known of
    cameras and what a run will cost. Ends with code 1 if a run would stop.

    Of a workspace: says which files are damaged and how to make them again, which photos are missing or
    weakly held and by what, which photos would bridge the parts of the scene, and what to try next, most
    promising first. Changes nothing. Ends with code 1 if there is damage or no model, or if the verdict on it
    is "wrong".
    """
    from corrsfm.workspace.manifest import has_lost_manifest

    for path in photos:
        if os.path.lexists(path / "workspace.json") or has_lost_manifest(path):
            if len(photos) > 1:
                command = shlex.join(["corrsfm", "check", str(path)])
                raise InputError(f"{path}: is a workspace; look at it alone, with: {command}")
            show_workspace(path, as_json, integrity)
            return
    from corrsfm.config import PipelineConfig, RunConfig
    from corrsfm.files import atomic_write_text
    from corrsfm.images.check import check_photos
    from corrsfm.images.listing import require_list
    from corrsfm.machine import count_threads

    if keep is not None:
        require_list(keep)
    result = check_photos(photos, mask_dir=mask_dir, threads=count_threads(threads))
    expected = None
    if forecast and len(result.kept) > 1:
        from corrsfm.forecast import forecast_run

        try:
            config = PipelineConfig(run=RunConfig(threads=threads))
            expected = forecast_run(result.folder, result.kept, config)
        except CorrsfmError as error:
            logger.warning("no forecast: %s", error)
    if keep is not None:
        # A line that begins with a hash is a comment.
        lines = (f"./{name}" if name.startswith("#") else name for name in result.kept)
        atomic_write_text(keep, "".join(f"{line}\n" for line in lines))
    if as_json:
        echo_json({**result.to_dict(), "forecast": expected and expected.to_dict()})
    else:
        sizes = Counter((photo.width, photo.height) for photo in result.photos)
        shown = ", ".join(f"{num} of {width}×{height}" for (width, height), num in sizes.most_common())
        click.echo(f"{result.folder}: {len(result.photos)} photos can be read: {shown}")
        click.echo(f"cameras proposed: {result.num_cameras}")
        for finding in result.findings:
            named = f": {first_few(finding.photos)}" if finding.photos else ""
            click.echo(f"{finding.kind}: {finding.text}{named}")
            if finding.next_step:
                click.echo(f"  next: {_command(photos, finding.next_step)}")
        if not result.findings:
            click.echo("nothing to object to")
        if expected is not None:
            click.echo(f"forecast: {expected}")
    if result.stops_a_run:
        raise click.exceptions.Exit(1)


def _command(photos: Sequence[Path], options: str) -> str:
    """What to paste: the run with more options, after the list is written if they need one."""
    given = shlex.join(map(str, photos))
    run = f"corrsfm run {given} scene/ {options}"
    return f"corrsfm check {given} --keep keep.txt --no-forecast; {run}" if "keep.txt" in options else run
