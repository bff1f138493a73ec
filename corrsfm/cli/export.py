"""The command that hands a finished scene to the next tool."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from corrsfm.cli.options import echo_json, json_option
from corrsfm.export import ExportTarget

__all__ = ["NEXT", "export"]

PATH = click.Path(path_type=Path)

_COLMAP = "colmap gui --database_path {}/database.db --image_path {}/images --import_path {}/sparse/0"
# What to paste next; {} is the output.
NEXT = {
    ExportTarget.SPLAT: "python train.py -s {}",
    ExportTarget.NERFSTUDIO: "ns-train splatfacto --data {}",
    ExportTarget.COLMAP: _COLMAP,
    ExportTarget.COLMAP3: _COLMAP,
    ExportTarget.OPENMVS: "InterfaceCOLMAP -i {} -o {}/scene.mvs",
}


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


@click.command(epilog=_TARGETS)
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
    metavar="A B METRES",
    help="Bring the world to metres: two photos, and how far apart they were taken.",
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
        workspace_dir, output, target, images_dir=images_dir, upright=upright, scale=scale, crop=crop
    )
    if as_json:
        echo_json(result.to_dict())
        return
    num_all = len(result.photos) + len(result.left_out)
    click.echo(f"{output}: {len(result.photos)} of {num_all} photos, {result.num_points:,} points")
    if result.num_cropped:
        click.echo(f"cropped: {result.num_cropped:,} points")
    if result.left_out:
        why = shlex.join(["corrsfm", "report", str(workspace_dir)])
        click.echo(f"left out, not in sparse/0: {', '.join(result.left_out)}\nwhy: {why}")
    if command := NEXT.get(result.target):
        click.echo(f"next: {command.replace('{}', shlex.quote(str(output)))}")
