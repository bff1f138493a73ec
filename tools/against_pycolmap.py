"""corrsfm beside plain pycolmap on the same photos: registered photos, points, error and seconds.

    python tools/against_pycolmap.py results/against_pycolmap.json SCENE/images …

Plain pycolmap is `extract_features`, `match_exhaustive` and `incremental_mapping` with its defaults and the
same number of features; corrsfm is `corrsfm run --method loransac` and, if --methods says so, others. Both
run in processes of their own, one after the other, on the same machine; processor seconds are the fair figure
on a machine that others use too.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from corrsfm.evaluation.records import provenance, save_results

PLAIN = """
import sys
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
pycolmap.extract_features(database, images, extraction_options=options, device=pycolmap.Device.cpu)
pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
pycolmap.incremental_mapping(database, images, out)
"""


def timed(command: list[str]) -> tuple[float, float]:
    """Wall-clock and processor seconds of a process and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    started = time.monotonic()
    subprocess.run(command, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path)
    parser.add_argument("images", type=Path, nargs="+")
    parser.add_argument("--methods", default="loransac")
    parser.add_argument("--max-features", type=int, default=4096)
    arguments = parser.parse_args()
    rows = []
    for images in arguments.images:
        scene = images.parent.name if images.name == "images" else images.name
        num_photos = sum(1 for path in images.rglob("*") if path.is_file())
        with tempfile.TemporaryDirectory() as folder:
            for method in ["pycolmap", *arguments.methods.split(",")]:
                out = Path(folder) / method
                if method == "pycolmap":
                    command = [
                        sys.executable,
                        "-c",
                        PLAIN,
                        str(images),
                        str(out),
                        str(arguments.max_features),
                    ]
                else:
                    command = [sys.executable, "-m", "corrsfm", "-q", "run", images, out]
                    command += ["--method", method, "--max-features", arguments.max_features]
                wall, processor = timed([str(word) for word in command])
                row = {"scene": scene, "photos": num_photos, "method": method, **largest_model(out)}
                rows.append({**row, "seconds": wall, "processor_seconds": processor})
                print(json.dumps(rows[-1]), file=sys.stderr)
        save_results(
            arguments.results,
            "pycolmap",
            {
                "provenance": provenance(
                    seed=0, command=" ".join(["python tools/against_pycolmap.py", *sys.argv[1:]])
                ),
                "subject": {"max_features": arguments.max_features},
                "rows": rows,
            },
        )


if __name__ == "__main__":
    main()
