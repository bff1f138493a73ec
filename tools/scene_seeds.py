"""Whole scenes over several seeds, by several settings: the median and the worst pose AUC@5.

    python tools/scene_seeds.py results/scene_seeds.json SCENE …

Each SCENE is a folder with images/ and a COLMAP model of known cameras. Photos are extracted, matched and
pruned once a setting; each seed then verifies, decides cameras, maps and chooses. Workspaces stay in --work,
and what they and the result file hold already is not done again.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from corrsfm.evaluation.records import provenance, save_results

# Name → flags of `extract` and of `reconstruct`.
SETTINGS: dict[str, tuple[list[str], list[str]]] = {
    "a camera each, first model": (
        ["--camera-mode", "per-image"],
        ["--max-models-tried", "1"],
    ),
    "default": ([], []),
}


def corrsfm(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command of this environment's corrsfm."""
    command = [sys.executable, "-m", "corrsfm", "-q", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def reconstruct(workspace: Path, scene: Path, seed: int, flags: list[str]) -> dict[str, Any]:
    """One seed: verify, map, choose, and measure against the known cameras."""
    corrsfm("prune", workspace, "--seed", seed)
    started = time.monotonic()
    corrsfm("reconstruct", workspace, "--seed", seed, *flags)
    seconds = time.monotonic() - started
    measured = corrsfm("evaluate", "scene", workspace, "--ground-truth", scene, "--seeds", 1, "--json")
    score = json.loads(measured.stdout) if measured.returncode == 0 else {}
    evidence = workspace / "evidence.json"
    values = json.loads(evidence.read_text(encoding="utf-8")) if evidence.exists() else {}
    return {
        "seed": seed,
        "auc5": score.get("auc", {}).get("5", 0.0),
        "num_registered": score.get("num_registered", 0),
        "num_photos": score.get("num_photos"),
        "grade": values.get("verdict", {}).get("grade"),
        "num_tried": len(values.get("models_tried", [])) or 1,
        "seconds": round(seconds, 1),
    }


def main() -> None:
    """Measure every scene and setting, and save after each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--work", type=Path, default=Path("runs/scene_seeds"))
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if arguments.results.exists():
        rows = json.loads(arguments.results.read_text(encoding="utf-8"))["rows"]
    for scene in arguments.scenes:
        for setting, (extract, flags) in SETTINGS.items():
            if any(row["scene"] == scene.name and row["setting"] == setting for row in rows):
                continue
            workspace = arguments.work / scene.name / setting.replace(" ", "_").replace(",", "")
            corrsfm("extract", scene / "images", workspace, *extract)
            runs = [reconstruct(workspace, scene, seed, flags) for seed in range(arguments.seeds)]
            rows.append({"scene": scene.name, "setting": setting, "runs": runs})
            values = {
                "provenance": provenance(
                    seed=0, command=" ".join(["python tools/scene_seeds.py", *sys.argv[1:]])
                ),
                "rows": rows,
            }
            save_results(arguments.results, "scene_seeds", values)
            print(scene.name, setting, [run["auc5"] for run in runs], flush=True)


if __name__ == "__main__":
    main()
