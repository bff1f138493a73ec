"""How time and memory of the bookkeeping grow with a scene: tiny photos through all steps but mapping.

    python tools/growth.py WORK_FOLDER --photos 1000 --photos 10000 --results results/growth.json

Photos are 64 × 48 pixels of noise, each paired with its next twenty. Extraction, matching and pruning return
the same twenty keypoints and eight matches for all, so that what is measured is the care for them: listing,
hashing, looking up what is finished, writing features, matches and the database. Every step runs in a process
of its own, whose largest resident memory is taken. The steps are run a second time with nothing to do, and a
third time with one pair added to the list.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import cv2
import numpy as np

from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.features import stage as features_stage
from corrsfm.matches import stage as matches_stage
from corrsfm.prune import stage as prune_stage
from corrsfm.types import Features, Matches, PruneResult
from corrsfm.workspace import Workspace

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.house_tables import keep_row  # noqa: E402

WIDTH, HEIGHT = 64, 48
NEIGHBOURS = 20
NUM_KEYPOINTS, NUM_MATCHES = 20, 8
PHOTOS_IN_A_FOLDER = 1000


def write_photos(folder: Path, num: int) -> list[str]:
    """Photos of smooth noise, all different; their names, sorted."""
    names = [f"{number // PHOTOS_IN_A_FOLDER:04d}/{number:07d}.png" for number in range(num)]
    for number, name in enumerate(names):
        path = folder / name
        if path.exists():
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        noise = np.random.default_rng(number).integers(0, 255, (HEIGHT // 4, WIDTH // 4)).astype(np.uint8)
        cv2.imwrite(str(path), cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC))
    return names


def write_pairs(path: Path, names: list[str], num_more: int = 0) -> int:
    """Each photo with its next ones, and some pairs more; their number."""
    num = 0
    with open(path, "w", encoding="utf-8") as file:
        for first, name in enumerate(names):
            for other in names[first + 1 : first + 1 + NEIGHBOURS]:
                file.write(f"{name} {other}\n")
                num += 1
        for more in range(num_more):
            file.write(f"{names[more]} {names[-1 - more]}\n")
    return num + num_more


def steps(root: Path) -> Mapping[str, Callable[[Workspace], object]]:
    """The steps of a run, by name."""
    run = cfg.RunConfig(threads=1, device="cpu")
    pairs = cfg.PairsConfig(pairing=(cfg.PairStrategy.FILE,), pairs_file=root / "pairs.txt")
    prune = cfg.PruneConfig(method=cfg.PruneMethod.RATIO)
    features = cfg.FeaturesConfig(max_features=20)
    return {
        "photos": lambda scene: pipeline.index_photos(scene, root / "photos", cfg.ImagesConfig(), run),
        "features": lambda scene: pipeline.extract_features(scene, features, run),
        "pairs": lambda scene: pipeline.make_pairs(scene, pairs, run),
        "matches": lambda scene: pipeline.match_pairs(scene, cfg.MatchesConfig(), run),
        "kept matches": lambda scene: pipeline.prune_matches(scene, prune, run),
        "database": lambda scene: pipeline.verify_matches(scene, cfg.DatabaseConfig(), run),
        "report": lambda scene: pipeline.report(scene, html=True),
    }


@dataclass(frozen=True)
class SimplePruner:
    """Keeps the same of every pair, and is taken for a real one."""

    fingerprint: str
    kept: PruneResult

    def __call__(self, pairs: list) -> list[PruneResult]:
        return [self.kept] * len(pairs)


def make_all_items_alike() -> None:
    """Put constants in the place of the arithmetic of extraction, matching and pruning."""
    features = Features(
        keypoints=np.linspace(1, 40, 2 * NUM_KEYPOINTS, dtype=np.float32).reshape(-1, 2),
        scales=np.ones(NUM_KEYPOINTS, np.float32),
        orientations=np.zeros(NUM_KEYPOINTS, np.float32),
        scores=np.ones(NUM_KEYPOINTS, np.float32),
        descriptors=np.full((NUM_KEYPOINTS, 128), 45, np.uint8),
        image_size=(WIDTH, HEIGHT),
    )
    indices = np.repeat(np.arange(NUM_MATCHES, dtype=np.int32)[:, None], 2, axis=1)
    ones = np.ones(NUM_MATCHES, np.float32)
    matches = Matches(indices=indices, ratios=0.5 * ones, mutual=ones > 0)
    kept = PruneResult(scores=ones, inlier_mask=ones > 0)
    build = prune_stage.build_pruner

    def build_alike(*arguments: Any, **options: Any) -> Any:
        return SimplePruner(build(*arguments, **options).fingerprint, kept)

    for module, name, constant in (
        (features_stage, "create_extractor", lambda *_: lambda image, mask: features),
        (matches_stage, "create_matcher", lambda *_, **__: lambda name0, name1: matches),
        (prune_stage, "make_correspondences", lambda *_: None),
        (prune_stage, "build_pruner", build_alike),
    ):
        setattr(module, name, constant)


def run_step(root: Path, name: str) -> None:
    """Run one step in this process and print its seconds and memory."""
    make_all_items_alike()
    workspace = Workspace(root / "scene", create=True)
    with workspace.lock():
        started = time.perf_counter()
        steps(root)[name](workspace)
        seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(json.dumps({"seconds": round(seconds, 2), "peak_gib": round(peak, 3)}))


def measure(root: Path, num_photos: int) -> dict:
    """All steps three times; seconds and memory of each."""
    names = write_photos(root / "photos", num_photos)
    num_pairs = write_pairs(root / "pairs.txt", names)
    row: dict = {"num_photos": num_photos, "num_pairs": num_pairs}
    for kind in ("first run", "nothing to do", "one more pair"):
        if kind == "one more pair":
            write_pairs(root / "pairs.txt", names, num_more=1)
        row[kind] = {}
        for name in steps(root):
            command = [sys.executable, __file__, str(root), "--step", name]
            quiet = {**os.environ, "TQDM_DISABLE": "1"}
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=quiet)
            row[kind][name] = json.loads(done.stdout.splitlines()[-1])
            print(num_photos, kind, name, row[kind][name], file=sys.stderr, flush=True)
    scene = root / "scene"
    row["bytes"] = {
        path.name: path.stat().st_size
        for path in [*scene.iterdir(), *(scene / "pruned").iterdir()]
        if path.is_file() and path.stat().st_size > 1000
    }
    return row


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--photos", "sizes", type=int, multiple=True, default=[1000], show_default=True)
@click.option("--results", type=click.Path(path_type=Path), help="JSON file; rows of other sizes stay.")
@click.option("--step", hidden=True)
def main(folder: Path, sizes: tuple[int, ...], results: Path | None, step: str | None) -> None:
    """Measure how the bookkeeping of a scene grows."""
    if step is not None:
        run_step(folder, step)
        return
    for size in sizes:
        row = measure(folder / f"{size}", size)
        if results is not None:
            command = f"python tools/growth.py WORK_FOLDER --photos {size} --results results/growth.json"
            keep_row(results, "growth", f"{size} photos", row, command=command)


if __name__ == "__main__":
    main()
