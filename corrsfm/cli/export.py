"""The command that hands a finished scene to the next tool."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from corrsfm.cli.options import PATH, echo_json, json_option
from corrsfm.export import ExportTarget

__all__ = ["NEXT", "export"]


_COLMAP = "colmap gui --database_path {}/database.db --image_path {}/images --import_path {}/sparse/0"
# What to paste next; {} is the output.
NEXT = {
    ExportTarget.SPLAT: "python train.py -s {}",
    ExportTarget.NERFSTUDIO: "ns-train splatfacto --data {}",
    ExportTarget.COLMAP: _COLMAP,
    ExportTarget.COLMAP3: _COLMAP,
    ExportTarget.OPENMVS: "InterfaceCOLMAP -i {} -o {}/scene.mvs",
}


_BY_GPS = ("gps", "gps", 0.0)


class _ExportCommand(click.Command):
    """A command whose ``--scale`` takes one word, gps, or three."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Write the one word as the three that the option always has."""
        spelled: list[str] = []
        for word in args:
            if word == "--scale=gps":
                spelled += ["--scale", *map(str, _BY_GPS)]
            elif word == "gps" and spelled[-1:] == ["--scale"]:
                spelled += map(str, _BY_GPS)
            else:
                spelled.append(word)
        return super().parse_args(ctx, spelled)


# The mark keeps click from filling the lines.
_TARGETS = """\b
splat       Gaussian splatting: gaussian-splatting, gsplat
nerfstudio  nerfstudio: transforms.json
colmap      COLMAP 4
colmap3     COLMAP 3.8
hloc        hloc: features, matches, model
openmvs     OpenMVS: InterfaceCOLMAP
bundler     CMVS, MeshLab
nvm         VisualSFM, MeshLab
ply         viewers: one file of points
csv         spreadsheets: one file, a line a photo"""


@click.command(cls=_ExportCommand, epilog=_TARGETS)
@click.argument("workspace_dir", metavar="WORKSPACE", type=PATH)
@click.argument("output", metavar="OUT", type=PATH)
@click.option(
    "--for",
    "target",
    type=click.Choice([str(target) for target in ExportTarget]),
    required=True,
    help="The tool that comes next, see below.",
)
@click.option("--upright", is_flag=True, help="Turn the world so that the cameras' common up is +z.")
@click.option(
    "--scale",
    nargs=3,
    type=(str, str, float),
    metavar="A B METRES | gps",
    help="Bring the world to metres: two photos, and how far apart they were taken; or the word gps, to lay "
    "it on the ground by the positions in EXIF, with axes east, north and up.",
)
@click.option(
    "--crop",
    is_flag=True,
    help="Drop points outside twice the box that holds the middle 90 % of them along each axis.",
)
@click.option("--images", "images_dir", type=PATH, help="Where the photos are, if their folder was moved.")
@json_option
def export(
    workspace_dir: Path,
    output: Path,
    target: str,
    upright: bool,
    scale: tuple[str, str, float] | None,
    crop: bool,
    images_dir: Path | None,
    as_json: bool,
) -> None:
    """Hand a finished scene to the next tool.

    Exports the model sparse/0 with the photos that it holds. splat, openmvs, bundler and nvm get undistorted
    photos; nerfstudio keeps the distortion that it can express. The workspace is not changed.
    """
    from corrsfm.export.scene import export_scene

    result = export_scene(
        workspace_dir,
        output,
        target,
        images_dir=images_dir,
        upright=upright,
        scale="gps" if scale == _BY_GPS else scale,
        crop=crop,
    )
    if as_json:
        echo_json(result.to_dict())
        return
    num_all = len(result.photos) + len(result.left_out)
    click.echo(f"{output}: {len(result.photos)} of {num_all} photos, {result.num_points:,} points")
    if result.gps is not None:
        fit, (latitude, longitude, altitude) = result.gps, result.gps.origin
        click.echo(
            f"GPS: {fit.num_agreeing} of {fit.num_photos} positions agree, the median is "
            f"{fit.residual_m:.2f} m off; "
            f"metres east, north and up of {latitude:.7f}, {longitude:.7f}, {altitude:.1f} m"
        )
    if result.num_cropped:
        click.echo(f"cropped: {result.num_cropped:,} points")
    if result.left_out:
        why = shlex.join(["corrsfm", "report", str(workspace_dir)])
        click.echo(f"left out, not in sparse/0: {', '.join(result.left_out)}\nwhy: {why}")
    if command := NEXT.get(result.target):
        click.echo(f"next: {command.replace('{}', shlex.quote(str(output)))}")
