"""Commands that measure: two-view poses, homographies, whole scenes."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click

from corrsfm.cli.options import (
    PATH,
    RESULT_FILE,
    echo_json,
    json_option,
    overwrite_option,
    run_options,
    seeds_option,
)
from corrsfm.config import RunConfig

__all__ = ["command_line", "evaluate"]

FILTERS = (
    "nn, mutual, ratioT, ratioT+mutual (T such as 0.8), oracle (the inliers), or a method of "
    "`corrsfm prune` as METHOD[@sfm|@pose][:CHECKPOINT]"
)
ESTIMATORS = (
    "ransac, usac, accurate, magsac, prosac, degensac, colmap, poselib or w8pt, with :PIXELS if wanted"
)
results_option = click.option(
    "--results", type=RESULT_FILE, help="Result file; what it holds already is not measured again."
)


@click.group()
def evaluate() -> None:
    """Measure methods and reconstructions."""


def command_line() -> str:
    """The command as typed, for result files: the program by its name, not its place."""
    return shlex.join(["corrsfm", *sys.argv[1:]])


def _device(run: RunConfig) -> str:
    from corrsfm.machine import count_threads, find_device, use_threads

    use_threads(count_threads(run.threads))
    return find_device(run.device)


def _filter_bar(name: str, total: int) -> Callable[[int], None]:
    from tqdm import tqdm

    bar = tqdm(total=total, desc=name, unit="pair")

    def advance(count: int) -> None:
        bar.update(count)
        if bar.n >= total:
            bar.close()

    return advance


def _show(values: dict[str, Any], as_json: bool) -> None:
    from corrsfm.evaluation.tables import render_table

    if as_json:
        echo_json(values)
    else:
        click.echo(render_table(values))


@evaluate.command()
@click.argument("pairs_file", metavar="FILE.h5", type=PATH)
@click.option(
    "--method",
    "methods",
    multiple=True,
    help=f"FILTER/ESTIMATOR; give it several times; the classical ones if not given. Filters: {FILTERS}. "
    f"Estimators: {ESTIMATORS}.",
)
@click.option("--baseline", help="Method that differences refer to; the first one if not given.")
@click.option("--max-per-scene", type=click.IntRange(min=1), help="Random pairs used of each scene.")
@results_option
@run_options
@overwrite_option
@json_option
def pose(
    pairs_file: Path,
    methods: tuple[str, ...],
    baseline: str | None,
    max_per_scene: int | None,
    results: Path | None,
    run: RunConfig,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Measure relative poses and kept matches on labelled pairs.

    FILE.h5 is in OANet's layout (YFCC100M, SUN3D) or comes from `corrsfm train prepare`.
    """
    from corrsfm.evaluation.two_view.methods import CLASSICAL_METHODS
    from corrsfm.evaluation.two_view.pose import evaluate_pose

    values = evaluate_pose(
        pairs_file,
        methods or CLASSICAL_METHODS,
        results=results,
        baseline=baseline,
        max_per_scene=max_per_scene,
        seed=run.seed,
        device=_device(run),
        threads=run.threads,
        overwrite=overwrite,
        command=command_line(),
        on_filter=_filter_bar,
    )
    _show({"kind": "pose", **values}, as_json)


@evaluate.command()
@click.argument("folder", metavar="DIR", type=PATH)
@click.option("--filter", "filters", multiple=True, help=f"Filter; give it several times. {FILTERS}.")
@results_option
@run_options
@overwrite_option
@json_option
def homography(
    folder: Path,
    filters: tuple[str, ...],
    results: Path | None,
    run: RunConfig,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Measure homographies of planes on a folder in HPatches' layout."""
    from tqdm import tqdm

    from corrsfm.evaluation.two_view.homography import evaluate_homography

    with tqdm(unit="sequence") as bar:

        def advance(name: str, total: int) -> None:
            bar.total = total
            bar.set_description(name)
            bar.update()

        values = evaluate_homography(
            folder,
            filters or ("nn", "mutual", "ratio0.8+mutual", "oracle"),
            results=results,
            seed=run.seed,
            device=_device(run),
            threads=run.threads,
            overwrite=overwrite,
            command=command_line(),
            on_sequence=advance,
        )
    _show({"kind": "homography", **values}, as_json)


@evaluate.command()
@click.argument("workspace_dir", metavar="WORKSPACE", type=PATH)
@click.option(
    "--ground-truth",
    required=True,
    type=PATH,
    help="COLMAP model, or folder of camera files PHOTO.json with the rotation (3 × 3) and translation (3) "
    "of cam_from_world.",
)
@seeds_option
@run_options
@json_option
def scene(workspace_dir: Path, ground_truth: Path, num_seeds: int, run: RunConfig, as_json: bool) -> None:
    """Compare a reconstruction with known cameras. WORKSPACE may also be a COLMAP model.

    A workspace is also mapped with further seeds, in WORKSPACE/.seeds: a single model is one draw. Its own
    seed is that of run.json, or --seed if it was made step by step.
    """
    from corrsfm.evaluation.scenes.score import evaluate_scene
    from corrsfm.evaluation.scenes.seeds import evaluate_seeds, why_one_model
    from corrsfm.evaluation.tables import render_table

    why = why_one_model(workspace_dir) if num_seeds > 1 else "--seeds 1"
    values = (
        evaluate_scene(workspace_dir, ground_truth).to_dict()
        if why
        else evaluate_seeds(workspace_dir, ground_truth, num_seeds, run)
    )
    if as_json:
        echo_json(values)
        return
    for line in _score_lines(values):
        click.echo(line)
    click.echo(f"\none model: {why}" if why else "\n" + render_table({"kind": "scene", **values}))


def _score_lines(score: dict[str, Any]) -> Iterator[str]:
    yield f"registered          {score['num_registered']} of {score['num_photos']} photos"
    for threshold, value in score["auc"].items():
        yield f"pose AUC@{threshold + '°':<11}{value:.1f} %"
    if score["position_error_mean"] is None:
        why = "fewer than 3 registered photos, or all on a line or in one place"
        yield f"position error      undetermined: {why}"
        return
    percent = score["position_error_percent"]
    share = "" if percent is None else f" (mean {percent:.2f} % of its extent)"
    yield (
        f"position error      mean {score['position_error_mean']:.4g}, "
        f"median {score['position_error_median']:.4g}, max {score['position_error_max']:.4g} "
        f"in units of the ground truth{share}"
    )
