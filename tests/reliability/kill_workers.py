"""Reconstruct a scene on a Dask cluster while workers, clients and schedulers are killed; print a table.

PYTHONPATH=.:tests/support python tests/reliability/kill_workers.py sample_scenes/courtyard /tmp/storm \
    --results results/reliability.json
"""

import argparse
import random
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

from dask_processes import ENVIRONMENT, DaskProcesses, Storm, differences

from tools.house_tables import keep_row

COMMAND = (
    "PYTHONPATH=.:tests/support python tests/reliability/kill_workers.py sample_scenes/courtyard /tmp/storm "
    "--results results/reliability.json"
)
COUNTED = "another result than one machine's by a byte, a traceback, a file left"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, epilog="Further options are those of corrsfm run.")
    parser.add_argument("scene", type=Path, help="folder with images/")
    parser.add_argument("output", type=Path, help="folder for the workspaces; what is there of them goes")
    parser.add_argument("--kills", type=int, default=100, help="killed workers to reach")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pause", type=float, default=6.0, help="longest between two kills [s]")
    parser.add_argument("--results", type=Path, help="result file, for the tables")
    values, options = parser.parse_known_args()
    words = [sys.executable, "-m", "corrsfm", "-q", "run", str(values.scene / "images")]
    reference = values.output / "reference"
    subprocess.run([*words, str(reference), *options], env=ENVIRONMENT, check=True, stdout=subprocess.DEVNULL)
    kills, ends, num_faults = Counter(), Counter(), 0
    print("| run | killed workers | clients | schedulers | starts | exit codes | differences |", flush=True)
    print("| --- | --- | --- | --- | --- | --- | --- |", flush=True)
    number = 0
    while kills["worker"] < values.kills:
        workspace = values.output / f"storm-{number}"
        shutil.rmtree(workspace, ignore_errors=True)
        with DaskProcesses(values.workers) as processes:
            command = [*words, str(workspace), "--cluster", processes.address, "--wait", *options]
            storm = Storm(
                command, processes, random.Random(values.seed + number), workspace / ".shards",
                pause=(0.1 * values.pause, values.pause),
            )  # fmt: skip
            storm.run(1800)
        found = differences(reference, workspace)
        found += [f"left over: {path}" for path in workspace.glob(".shards/**/*")]
        print(
            f"| {number} | {storm.kills['worker']} | {storm.kills['client']} | {storm.kills['scheduler']} "
            f"| {storm.ends.total()} | {dict(storm.ends)} | {'; '.join(found[:3]) or 'none'} |",
            flush=True,
        )
        for error in storm.errors:
            print(f"    {error}", file=sys.stderr, flush=True)
        num_faults += bool(found) or any("Traceback" in error for error in storm.errors)
        kills += storm.kills
        ends += storm.ends
        number += 1
    print(f"| all | {kills['worker']} | {kills['client']} | {kills['scheduler']} | {ends.total()} | | |")
    if values.results:
        row = {"number": kills.total(), "faults": num_faults, "counted": COUNTED, "seed": values.seed}
        keep_row(values.results, "reliability", "killed Dask processes", {**row, **kills}, command=COMMAND)


if __name__ == "__main__":
    main()
