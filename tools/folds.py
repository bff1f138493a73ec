"""What unfolding does to scenes, folded ones and others, over several seeds.

    python tools/folds.py results/folds.json SCENES [--splits train,val] [--largest 14] [--also NAMES]

SCENES holds a folder a scene, each with images/ and a COLMAP model of known cameras, and splits.json. Every
seed verifies and maps with corrsfm's defaults; where a model was unfolded, the same seed is mapped again with
--no-unfold. Small scenes come first. Each is saved as soon as it is done, and what the result file holds
already is not done again.
"""

import argparse
import json
import shlex
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from corrsfm.errors import CorrsfmError
from corrsfm.evaluation.metrics import extent_of
from corrsfm.evaluation.records import provenance, save_results
from corrsfm.evaluation.scenes.score import read_poses
from corrsfm.geometry import Pose, camera_centre, rotation_angle_deg

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tools.whole_scenes import call, measure  # noqa: E402

_NEAR_SHARE, _NEAR_DEG = 0.05, 10.0


def run_seed(scene: Path, pruned: Path, seed: int) -> dict[str, Any]:
    """One seed of a scene: what was noticed and done, and the score with and without it."""

    workspace = pruned.with_name("workspace")

    def reconstruct(*flags: str) -> tuple[dict[str, Any], dict[str, Any]]:
        shutil.rmtree(workspace, ignore_errors=True)
        shutil.copytree(pruned, workspace)
        for command in (["prune"], ["reconstruct", *flags]):
            call("-m", "corrsfm", "-q", command[0], workspace, *command[1:], "--seed", seed, "--threads", 1)
        evidence = workspace / "evidence.json"
        found = json.loads(evidence.read_text(encoding="utf-8")) if evidence.exists() else {}
        return measure(workspace, scene, seed), found

    row, evidence = reconstruct()
    try:
        row["num_in_place"] = count_in_place(read_poses(workspace), read_poses(scene))
    except CorrsfmError:
        row["num_in_place"] = 0
    folds = evidence.get("folds", {})
    names = [model["name"] for model in evidence.get("models_tried", []) if model["chosen"]]
    row |= {
        "chosen": names[0] if names else None,
        "unfolded_by": next((name for name in names if name.startswith("unfolded")), None),
        "still_folded": folds.get("folded"),
        "num_near_pairs": folds.get("num_near_pairs"),
        "num_left_out": len(folds.get("left_out", [])),
    }
    if row["unfolded_by"]:
        plain, evidence = reconstruct("--no-unfold")
        row["without"] = plain | {"folded": evidence.get("folds", {}).get("folded")}
    return row


def count_in_place(poses: Mapping[str, Pose], truth: Mapping[str, Pose]) -> int:
    """Photos in the largest set that one similarity brings near their known cameras.

    Near is within 5 % of the extent of the known centres and 10 degrees. Every two photos suggest one.
    """
    names = sorted(poses.keys() & truth.keys())
    known, found = (
        np.array([camera_centre(own[name]) for name in names]).reshape(-1, 3) for own in (truth, poses)
    )
    extent = extent_of(np.array([camera_centre(pose) for pose in truth.values()]))
    turns = np.array([truth[name][0].T @ poses[name][0] for name in names])
    most = 0
    for i, turn in enumerate(turns):
        turned = np.array([rotation_angle_deg(turn.T @ other) for other in turns])
        for j in range(len(names)):
            baseline, found_baseline = (np.linalg.norm(own[j] - own[i]) for own in (known, found))
            # Two cameras in one place would shrink everything to it.
            if baseline > _NEAR_SHARE * extent and found_baseline > 0:
                scale = baseline / found_baseline
                moved = known[i] + scale * (found - found[i]) @ turn.T
                near = np.linalg.norm(moved - known, axis=1) <= _NEAR_SHARE * extent
                most = max(most, int((near & (turned <= _NEAR_DEG)).sum()))
    return most


def main() -> None:
    """Measure every scene and seed, and save after each scene."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--splits", default="train,val")
    parser.add_argument("--largest", type=int, default=14, help="photos of the largest scene")
    parser.add_argument("--also", default="", help="names of larger scenes")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--work", type=Path, default=Path("runs/folds"))
    arguments = parser.parse_args()
    rows: dict[str, Any] = {}
    if arguments.results.exists():
        rows = json.loads(arguments.results.read_text(encoding="utf-8"))["rows"]
    splits = json.loads((arguments.scenes / "splits.json").read_text(encoding="utf-8"))
    names = {name for split in arguments.splits.split(",") for name in splits[split]}
    sizes = {name: len(list((arguments.scenes / name / "images").iterdir())) for name in sorted(names)}
    for name in sorted(sizes, key=sizes.__getitem__):
        scene = arguments.scenes / name
        if name in rows or (sizes[name] > arguments.largest and name not in arguments.also.split(",")):
            continue
        pruned = arguments.work / name / "pruned"
        for words in (["extract", scene / "images", pruned], ["prune", pruned]):
            call("-m", "corrsfm", "-q", *words, "--threads", 1)
        rows[name] = [run_seed(scene, pruned, seed) for seed in range(arguments.seeds)]
        shutil.rmtree(pruned.parent)
        command = shlex.join(["python", "tools/folds.py", *sys.argv[1:]])
        save_results(
            arguments.results, "folds", {"provenance": provenance(seed=0, command=command), "rows": rows}
        )
        print(name, *rows[name], sep="\n  ", flush=True)


if __name__ == "__main__":
    main()
