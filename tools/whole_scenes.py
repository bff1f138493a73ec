"""Whole scenes over several seeds, by plain pycolmap, ALIKED + LightGlue and corrsfm.

    python tools/whole_scenes.py results/whole_scenes.json SCENE … [--only PATTERN]

Each SCENE is a folder with images/ and a COLMAP model of known cameras. Photos are extracted and matched once
a scene and kind of feature; each seed then verifies and maps, and corrsfm chooses cameras and model. Each run
is saved as soon as it is done, and what the result file or --work hold already is not done again. A run
without a model counts as 0. `tools/plain_pycolmap.py` says what the modes of pycolmap are, and
`tools/aliked_lightglue.py` what it needs; each step is a process on one thread.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from corrsfm.errors import CorrsfmError
from corrsfm.evaluation.records import provenance, save_results
from corrsfm.evaluation.scenes.score import evaluate_scene, read_poses

TOOLS = Path(__file__).resolve().parent


@dataclass(frozen=True, kw_only=True)
class Plain:
    """A mode of pycolmap: whose features, which cameras, which mapper."""

    name: str
    column: str
    features: str
    cameras: str
    mapper: str


@dataclass(frozen=True, kw_only=True)
class Corrsfm:
    """Flags of `extract`, `prune` and `reconstruct`."""

    name: str
    column: str
    extract: tuple[str, ...] = ()
    prune: tuple[str, ...] = ()
    reconstruct: tuple[str, ...] = ()


SETTINGS: list[Plain | Corrsfm] = [
    *(
        Plain(
            name=f"pycolmap, {features}, {mapper}, {'one camera' if cameras == 'one' else 'a camera each'}",
            column="plain pycolmap, best mode",
            features=features,
            cameras=cameras,
            mapper=mapper,
        )
        for features in ("default", "high")
        for cameras in ("one", "each")
        for mapper in ("incremental", "global")
    ),
    *(
        Plain(
            name=f"ALIKED + LightGlue, {mapper}, one camera",
            column="ALIKED + LightGlue, better mapper",
            features="aliked",
            cameras="one",
            mapper=mapper,
        )
        for mapper in ("incremental", "global")
    ),
    *(
        Corrsfm(name=f"corrsfm {method}", column=f"corrsfm {method}", prune=("--method", method))
        for method in ("ratio", "loransac", "corradaptor", "oanet")
    ),
    Corrsfm(
        name="corrsfm corradaptor, first model",
        column="corradaptor, first model",
        prune=("--method", "corradaptor"),
        reconstruct=("--max-models-tried", "1"),
    ),
    Corrsfm(
        name="corrsfm corradaptor, pycolmap's SIFT",
        column="corradaptor, pycolmap's SIFT",
        extract=("--extractor", "pycolmap"),
        prune=("--method", "corradaptor"),
    ),
    *(
        Corrsfm(
            name=f"corrsfm ALIKED, {name}",
            column=f"corrsfm ALIKED, {name}",
            extract=("--extractor", "aliked", "--max-features", "2048", "--matcher", matcher),
            prune=("--method", *prune),
        )
        for name, matcher, prune in (
            ("loransac", "nearest", ("loransac",)),
            ("small-aliked", "nearest", ("corradaptor", "--model", "small-aliked")),
            ("LightGlue", "lightglue", ("none",)),
        )
    ),
    *(
        # NAME_VARIANT.pt holds a network NAME that `tools/rivals.sh` trained.
        Corrsfm(
            name=f"rival {weights.stem}",
            column=weights.stem,
            prune=("--method", weights.stem.partition("_")[0], "--model", str(weights)),
        )
        for weights in sorted((TOOLS.parent / "results" / "rivals").glob("*.pt"))
    ),
]


def call(*words: object) -> bool:
    """Run a Python script or module on one thread, and say whether it ended well."""
    done = subprocess.run(
        [sys.executable, *map(str, words)],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        print(*words, done.stderr[-500:], sep="\n", file=sys.stderr, flush=True)
    return not done.returncode


def make(path: Path, script: str, *words: object) -> Path:
    """Make a database once; one that a script did not finish keeps another name."""
    partial = path.with_suffix(".partial")
    if not path.exists():
        if not call(TOOLS / script, *(partial if word is path else word for word in words)):
            sys.exit(f"error: {path} was not made")
        partial.rename(path)
    return path


def run_plain(setting: Plain, scene: Path, seed: int, work: Path) -> Path:
    """One seed of a mode of pycolmap: the folder of its model."""
    high = ["--high"] if setting.features == "high" else []
    images, matched = scene / "images", work / f"{setting.features}.db"
    if setting.features == "aliked":
        make(matched, "aliked_lightglue.py", images, matched)
    else:
        make(matched, "plain_pycolmap.py", "match", images, matched, *high)
    verified = work / f"{setting.features}_{seed}.db"
    make(verified, "plain_pycolmap.py", "verify", matched, verified, "--seed", seed, *high)
    model = work / "models" / f"{setting.features}_{setting.cameras}_{setting.mapper}_{seed}"
    shutil.rmtree(model, ignore_errors=True)
    modes = ["--cameras", setting.cameras, "--mapper", setting.mapper, "--seed", seed, *high]
    call(TOOLS / "plain_pycolmap.py", "map", verified, images, model, *modes)
    return model


def run_corrsfm(setting: Corrsfm, scene: Path, seed: int, work: Path) -> Path:
    """One seed of corrsfm: its workspace."""
    corrsfm = ["-m", "corrsfm", "-q"]
    extracted = work / "-".join(["extracted", *setting.extract])
    call(*corrsfm, "extract", scene / "images", extracted, *setting.extract, "--threads", 1)
    workspace = work / re.sub(r"\W+", "_", setting.name)
    pruned = workspace.with_name(f"{workspace.name}_pruned")
    # What a network keeps does not hang on the seed; `prune` makes the rest again.
    if not pruned.exists():
        shutil.rmtree(workspace, ignore_errors=True)
        shutil.copytree(extracted, workspace)
        call(*corrsfm, "prune", workspace, *setting.prune, "--threads", 1)
        workspace.rename(pruned)
    shutil.rmtree(workspace, ignore_errors=True)
    shutil.copytree(pruned, workspace)
    call(*corrsfm, "prune", workspace, *setting.prune, "--seed", seed, "--threads", 1)
    call(*corrsfm, "reconstruct", workspace, *setting.reconstruct, "--seed", seed, "--threads", 1)
    return workspace


def measure(model: Path, scene: Path, seed: int) -> dict[str, Any]:
    """Score a run against the known cameras; without a model it is 0."""
    evidence = model / "evidence.json"
    verdict = json.loads(evidence.read_text(encoding="utf-8")).get("verdict", {}) if evidence.exists() else {}
    try:
        score = evaluate_scene(model, scene)
    except CorrsfmError:
        auc5, num_registered, num_photos = 0.0, 0, len(read_poses(scene))
    else:
        auc5, num_registered, num_photos = score.auc["5"], score.num_registered, score.num_photos
    return {
        "seed": seed,
        "auc5": round(auc5, 2),
        "num_registered": num_registered,
        "num_photos": num_photos,
        "grade": verdict.get("grade"),
    }


def main() -> None:
    """Measure every scene, setting and seed, and save after each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--only", default="", help="regular expression for names of settings")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--work", type=Path, default=Path("runs/whole_scenes"))
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    if arguments.results.exists():
        rows = json.loads(arguments.results.read_text(encoding="utf-8"))["rows"]
    for scene in arguments.scenes:
        work = arguments.work / scene.name
        work.mkdir(parents=True, exist_ok=True)
        for setting in SETTINGS:
            if not re.search(arguments.only, setting.name):
                continue
            row = {"scene": scene.name, "setting": setting.name, "column": setting.column, "runs": []}
            for known in rows:
                if (known["scene"], known["setting"]) == (scene.name, setting.name):
                    row = known
            for seed in range(len(row["runs"]), arguments.seeds):
                if isinstance(setting, Plain):
                    model = run_plain(setting, scene, seed, work)
                else:
                    model = run_corrsfm(setting, scene, seed, work)
                row["runs"].append(measure(model, scene, seed))
                if row not in rows:
                    rows.append(row)
                command = shlex.join(["python", "tools/whole_scenes.py", *sys.argv[1:]])
                values = {"provenance": provenance(seed=0, command=command), "rows": rows}
                save_results(arguments.results, "whole_scenes", values)
                print(scene.name, setting.name, row["runs"][-1], flush=True)


if __name__ == "__main__":
    main()
