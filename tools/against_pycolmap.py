"""corrsfm beside plain pycolmap on the same photos: what each registers, and the seconds of each stage.

    python tools/against_pycolmap.py results/against_pycolmap.json SCENE/images …

Plain pycolmap is `extract_features`, `match_exhaustive` and `incremental_mapping` with its defaults and the
same number of features; corrsfm is `corrsfm run` with the methods that --methods says. Every run is a process
of its own, first all methods on one core, then all on every core of this process, one after the other. Run it
on an idle machine; processor seconds are the fair figure on one that others use too. Scenes that the result
file holds already are not measured again.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from corrsfm.evaluation.records import load_results, provenance, save_results

PLAIN = """
import json, sys, time
from pathlib import Path
import corrsfm
import pycolmap
images, out, num_features = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
pycolmap.logging.minloglevel = 2
pycolmap.set_random_seed(0)
out.mkdir(parents=True)
database = out / "database.db"
options = pycolmap.FeatureExtractionOptions()
options.sift.max_num_features = num_features
times = [time.monotonic()]
pycolmap.extract_features(database, images, extraction_options=options, device=pycolmap.Device.cpu)
times.append(time.monotonic())
pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
times.append(time.monotonic())
pycolmap.incremental_mapping(database, images, out)
times.append(time.monotonic())
seconds = [round(after - before, 2) for before, after in zip(times, times[1:])]
(out / "report.json").write_text(json.dumps(
    {"stage_seconds": dict(zip(["features", "verified matches", "models"], seconds))}
))
"""


def timed(command: list[str], cores: set[int]) -> tuple[float, float]:
    """Wall-clock and processor seconds of a process and its children on some cores."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    started = time.monotonic()
    subprocess.run(
        command,
        check=False,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
        env={**os.environ, "OMP_NUM_THREADS": str(len(cores))},
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return round(time.monotonic() - started, 1), round(processor, 1)


def largest_model(folder: Path) -> dict[str, float | None]:
    """Counts of the model with most photos below a folder."""
    from corrsfm.colmap.models import summarise_model

    import pycolmap  # isort: skip

    models = [pycolmap.Reconstruction(path.parent) for path in folder.rglob("images.bin")]
    if not models:
        return {"registered": 0, "points": 0, "median_error_px": None}
    summary = summarise_model(max(models, key=lambda model: model.num_reg_images()))
    return {
        "registered": len(summary.image_names),
        "points": summary.num_points,
        "median_error_px": round(float(summary.median_error_px), 3),
    }


def measure(images: Path, method: str, num_features: int, cores: set[int]) -> dict[str, Any]:
    """One run: its model, seconds by stage, and seconds in all."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        if method == "pycolmap":
            command = [sys.executable, "-c", PLAIN, images, out, num_features]
        else:
            command = [sys.executable, "-m", "corrsfm", "-q", "run", images, out]
            command += ["--method", method, "--max-features", num_features]
        wall, processor = timed([str(word) for word in command], cores)
        # A run that failed leaves no report, and counts as one without a model.
        path = out / "report.json"
        report = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"stage_seconds": {}}
        return {
            "cores": len(cores),
            **largest_model(out),
            "stage_seconds": {name: round(value, 2) for name, value in report["stage_seconds"].items()},
            "seconds": wall,
            "processor_seconds": processor,
        }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path)
    parser.add_argument("images", type=Path, nargs="+")
    parser.add_argument("--methods", default="loransac,corradaptor,oanet")
    parser.add_argument("--max-features", type=int, default=4096)
    arguments = parser.parse_args()
    available = os.sched_getaffinity(0)
    rows: list[dict[str, Any]] = []
    if arguments.results.exists():
        rows = load_results(arguments.results, "pycolmap")["rows"]
    for images in arguments.images:
        scene = images.parent.name if images.name == "images" else images.name
        if any(row["scene"] == scene for row in rows):
            continue
        num_photos = sum(1 for path in images.rglob("*") if path.is_file())
        found = []
        for cores in [{min(available)}, available]:
            for method in ["pycolmap", *arguments.methods.split(",")]:
                run = measure(images, method, arguments.max_features, cores)
                found.append({"scene": scene, "photos": num_photos, "method": method, **run})
                print(json.dumps(found[-1]), file=sys.stderr, flush=True)
        rows += found
        command = " ".join(["python tools/against_pycolmap.py", *sys.argv[1:]])
        values = {
            "provenance": provenance(seed=0, command=command),
            "subject": {"max_features": arguments.max_features},
            "rows": rows,
        }
        save_results(arguments.results, "pycolmap", values)


if __name__ == "__main__":
    main()
