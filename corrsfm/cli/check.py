"""The command that looks at photos before a run."""

from __future__ import annotations

import shlex
from collections import Counter
from pathlib import Path

import click

from corrsfm.cli.finished import show_workspace
from corrsfm.cli.options import echo_json, json_option
from corrsfm.errors import first_few

__all__ = ["check"]

PATH = click.Path(path_type=Path)


@click.command()
@click.argument("images_dir", metavar="IMAGES|WORKSPACE", type=PATH)
@click.option(
    "--keep",
    type=PATH,
    help="Write the names of the photos to keep here, for --image-list: all but unreadable, blurred and"
    " doubled ones.",
)
@click.option("--threads", type=click.IntRange(0), default=0, help="Photos read at a time; 0 is all cores.")
@json_option
def check(images_dir: Path, keep: Path | None, threads: int, as_json: bool) -> None:
    """Look at photos before a run, or at a scene after it.

    Of photos: finds those that cannot be read, that are blurred, that show the same from the same place, or
    whose exposure is far from that of the others, and says what is known of cameras. Ends with code 1 if a
    run would stop.

    Of a workspace: says which photos are missing or weakly held and by what, which photos would bridge the
    parts of the scene, and what to try next, most promising first. Changes nothing. Ends with code 1 if there
    is no model or the verdict on it is "wrong".
    """
    if (images_dir / "workspace.json").is_file():
        show_workspace(images_dir, as_json)
        return
    from corrsfm.files import atomic_write_text
    from corrsfm.images.check import check_photos
    from corrsfm.machine import count_threads

    result = check_photos(images_dir, threads=count_threads(threads))
    if keep is not None:
        atomic_write_text(keep, "".join(f"{name}\n" for name in result.kept))
    if as_json:
        echo_json(result.to_dict())
    else:
        sizes = Counter((photo.width, photo.height) for photo in result.photos)
        shown = ", ".join(f"{num} of {width}×{height}" for (width, height), num in sizes.most_common())
        click.echo(f"{images_dir}: {len(result.photos)} photos can be read: {shown}")
        click.echo(f"cameras proposed: {result.num_cameras}")
        for finding in result.findings:
            click.echo(f"{finding.kind}: {finding.text}: {first_few(finding.photos)}")
            if finding.next_step:
                click.echo(f"  next: {_command(images_dir, finding.next_step)}")
        if not result.findings:
            click.echo("nothing to object to")
    if result.stops_a_run:
        raise click.exceptions.Exit(1)


def _command(images_dir: Path, options: str) -> str:
    """What to paste: the run with more options, after the list is written if they need one."""
    photos = shlex.quote(str(images_dir))
    run = f"corrsfm run {photos} scene/ {options}"
    return f"corrsfm check {photos} --keep keep.txt; {run}" if "keep.txt" in options else run
