"""The command that brings in features and matches of other tools."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from corrsfm import config as cfg
from corrsfm.cli.options import PATH, config_options, echo_json, json_option
from corrsfm.cli.sections import SectionedCommand

__all__ = ["import_"]


@click.command("import", cls=SectionedCommand, most_used=("features", "matches", "database", "kind"))
@click.argument("images_dir", metavar="IMAGES", type=PATH)
@click.argument("workspace_dir", metavar="WORKSPACE", type=PATH)
@click.option("--features", type=PATH, help="hloc's features.h5, of any extractor.")
@click.option("--matches", type=PATH, help="hloc's matches.h5, of any matcher, for these features.")
@click.option("--database", type=PATH, help="A COLMAP database, in place of these.")
@click.option(
    "--kind",
    type=click.Choice([str(kind) for kind in cfg.FeatureKind]),
    default=str(cfg.FeatureKind.OTHER),
    show_default=True,
    help="What the features are, so that the networks made for them are used.",
)
@click.option("--rematch", is_flag=True, help="Leave the matches of the database; corrsfm matches again.")
@config_options(images=cfg.ImagesConfig)
@click.option("--overwrite", is_flag=True, help="Replace features that the workspace holds.")
@json_option
def import_(
    images_dir: Path,
    workspace_dir: Path,
    features: Path | None,
    matches: Path | None,
    database: Path | None,
    kind: str,
    rematch: bool,
    images: cfg.ImagesConfig,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Bring in features and matches of another tool.

    Everything is checked before anything is written. `corrsfm run IMAGES WORKSPACE` goes on from there and
    keeps what came.
    """
    from corrsfm.importing.scene import import_features

    result = import_features(
        images_dir, workspace_dir, features=features, matches=matches, database=database, kind=kind,
        with_matches=not rematch, images=images, overwrite=overwrite,
    )  # fmt: skip
    if as_json:
        echo_json(result.to_dict())
        return
    size = f", descriptors of {result.descriptor_size} numbers" if result.descriptor_size else ""
    click.echo(f"{workspace_dir}: {result.num_photos} photos, {result.num_keypoints:,} keypoints{size}")
    command = ["corrsfm", "run", str(images_dir), str(workspace_dir)]
    if result.num_pairs:
        click.echo(f"{result.num_matches:,} matches of {result.num_pairs} pairs")
    if result.num_pairs or not result.has_shapes:
        # The network that is loaded by default reads ratios, scale and orientation.
        command += ["--method", "loransac"]
    click.echo(f"next: {shlex.join(command)}")
