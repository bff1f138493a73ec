"""Work on a Dask cluster: results, failures and losses; a scene made there is the one made here."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

distributed = pytest.importorskip("distributed")

from dask_processes import ENVIRONMENT, DaskProcesses, Storm, differences, no_orphans  # noqa: E402
from photos import write_photos  # noqa: E402

from corrsfm import cluster  # noqa: E402
from corrsfm.cluster import Cluster, connected  # noqa: E402
from corrsfm.errors import ClusterError, ConfigError, ImageError  # noqa: E402

FLAGS = ["--max-features", "500", "--max-models-tried", "1", "--device", "cpu"]


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A scheduler with a worker of two threads, in this process."""
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0"
    ) as local:
        yield local.scheduler_address


@pytest.fixture(scope="module")
def processes() -> Iterator[DaskProcesses]:
    with DaskProcesses(2) as processes:
        yield processes


def halve(number: int) -> int:
    if number == 3:
        raise ImageError("3.jpg: is odd")
    return 10 // number


def die(folder: str) -> None:
    (Path(folder) / str(os.getpid())).touch()
    os.kill(os.getpid(), signal.SIGKILL)


def corrsfm(*words: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "corrsfm", "-q", *map(str, words)]
    return subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True)


def test_every_task_has_an_outcome(address: str) -> None:
    with Cluster(address) as workers:
        outcomes = dict(workers.outcomes(halve, [(str(number), (number,)) for number in range(20)]))
    assert len(outcomes) == 20
    assert outcomes["5"] == 2
    assert isinstance(outcomes["0"], ZeroDivisionError)
    assert isinstance(outcomes["3"], ClusterError)
    assert str(outcomes["3"]).startswith("worker ") and str(outcomes["3"]).endswith(": 3.jpg: is odd")


def test_a_worker_of_another_version_is_refused(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with Cluster(address) as workers:
        versions = iter(["9.9.9 (abc)", "0.1.0 (def)", "0.1.0 (def)"])
        monkeypatch.setattr(cluster, "code_version", lambda: next(versions))
        ((_, error),) = workers.outcomes(halve, [("1", (1,))])
    assert str(error).endswith("has corrsfm 0.1.0 (def), the run has 9.9.9 (abc); install the same there")
    monkeypatch.setattr(cluster, "code_version", lambda: "9.9.9 (abc)")
    with pytest.raises(ClusterError, match=r"worker b: has corrsfm 0.1.0 \(def\), the run has 9.9.9 \(abc\)"):
        cluster._check_workers({"a": "9.9.9 (abc)", "b": "0.1.0 (def)", "c": OSError("is dying")})
    with pytest.raises(ClusterError, match=r"worker a: cannot run corrsfm .*No module named 'corrsfm'"):
        cluster._check_workers({"a": Exception("ModuleNotFoundError(\"No module named 'corrsfm'\")")})
    for missing in (
        ModuleNotFoundError("No module named 'corrsfm'"),
        RuntimeError("Error during deserialization of the task graph.\nFor more information"),
    ):
        assert str(cluster._explained(missing)).startswith("the scheduler or a worker cannot run corrsfm ")
    assert isinstance(cluster._explained(RuntimeError("no memory")), RuntimeError)


def test_the_version_tells_two_sources_of_one_number_apart() -> None:
    version, _, digest = cluster.code_version().partition(" ")
    assert version == cluster.__version__
    assert len(digest) == len("(0123456789ab)")


def test_one_connection_serves_what_is_within_it(address: str) -> None:
    with connected(None) as none:
        assert none is None
    with connected(address) as outer:
        with connected(address) as inner:
            assert inner is outer
        with connected(None) as none:
            assert none is None
    with pytest.raises(ConfigError, match="--cluster and --workers"), connected(address, 2):
        pass


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense"])
def test_an_address_without_a_scheduler_is_told_before_any_work(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_SECONDS", 1.0)
    with pytest.raises(ClusterError, match=f"{address}: no Dask scheduler answers there.*dask scheduler"):
        Cluster(address)


def test_a_task_that_kills_every_worker_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "MAX_SUBMISSIONS", 1)
    with Cluster(workers=2) as workers:
        outcomes = dict(workers.outcomes(die, [("a", (str(tmp_path),))]))
    assert str(outcomes["a"]).startswith("4 workers died while they did this")
    assert len(list(tmp_path.iterdir())) == 4


def test_a_lost_worker_costs_its_block_and_the_scene_is_that_of_one_machine(
    tmp_path: Path, processes: DaskProcesses
) -> None:
    write_photos(tmp_path / "photos", 8)
    words = ["run", tmp_path / "photos"]
    assert corrsfm(*words, tmp_path / "here", *FLAGS).returncode == 0
    storm = Storm(
        [sys.executable, "-m", "corrsfm", *map(str, words), str(tmp_path / "there"),
         "--cluster", processes.address, *FLAGS],
        processes, random.Random(0), tmp_path / "there" / ".shards",
        pause=(0.1, 1.0), odds=(1, 0, 0), max_kills=2,
    )  # fmt: skip
    storm.run(120)
    assert storm.kills["worker"] >= 1
    assert differences(tmp_path / "here", tmp_path / "there") == []
    assert not (tmp_path / "there" / ".shards").exists()
    record = json.loads((tmp_path / "there" / "run.json").read_text())
    assert record["config"]["run"]["cluster"] == processes.address


def test_what_workers_find_wrong_is_said_as_on_one_machine(tmp_path: Path, processes: DaskProcesses) -> None:
    write_photos(tmp_path / "photos", 5)
    whole = (tmp_path / "photos" / "2.png").read_bytes()
    (tmp_path / "photos" / "2.png").write_bytes(whole[: len(whole) // 2])
    there = ["--cluster", processes.address, *FLAGS]
    words = ["run", tmp_path / "photos", tmp_path / "scene"]
    here, result = corrsfm(*words, *FLAGS), corrsfm(*words, *there)
    assert result.returncode == here.returncode == 1
    errors = [text[text.index("Error: ") :] for text in (here.stderr, result.stderr)]
    assert errors[0] == errors[1]
    assert "2.png" in errors[0]
    result = corrsfm(*words, *there, "--skip-unreadable", "--method", "loransac")
    warnings = json.loads((tmp_path / "scene" / "warnings.json").read_text())
    assert any("left out" in text and "2.png" in text for text in sum(warnings.values(), []))


@pytest.mark.slow
def test_a_storm_over_a_sample_scene_changes_nothing(repository: Path, tmp_path: Path) -> None:
    words = ["run", repository / "sample_scenes" / "courtyard" / "images"]
    flags = ["--max-models-tried", "1"]
    assert corrsfm(*words, tmp_path / "here", *flags).returncode == 0
    with DaskProcesses(2) as processes:
        storm = Storm(
            [sys.executable, "-m", "corrsfm", "-q", *map(str, words), str(tmp_path / "there"),
             "--cluster", processes.address, *flags],
            processes, random.Random(os.getpid()), tmp_path / "there" / ".shards",
            pause=(0.3, 1.5), max_kills=12,
        )  # fmt: skip
        storm.run(900)
    # A fast machine is through with what can be killed in seconds.
    assert storm.kills.total() >= 2
    assert differences(tmp_path / "here", tmp_path / "there") == []
    assert all(error.splitlines()[-1].endswith("run the same command again") for error in storm.errors)


def batch_command(tmp_path: Path, *words: str) -> list[str]:
    collection = [str(tmp_path / "collection"), str(tmp_path / "out")]
    return [sys.executable, "-m", "corrsfm", "batch", *collection, *words, *FLAGS]


def worker_of(lock: Path, processes: DaskProcesses) -> int:
    """Number of the worker whose scene holds a workspace, once one does."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError, ValueError, subprocess.CalledProcessError):
            holder = json.loads(lock.read_text())["process"]
            parent = int(subprocess.check_output(["ps", "-o", "ppid=", "-p", str(holder)]))
            return [worker.pid for worker in processes.workers].index(parent)
        time.sleep(0.05)
    raise TimeoutError(lock)


def test_a_killed_worker_takes_its_scene_along_and_another_goes_on(
    tmp_path: Path, processes: DaskProcesses
) -> None:
    write_photos(tmp_path / "collection" / "a", 5)
    process = subprocess.Popen(
        batch_command(tmp_path, "--dask", processes.address),
        env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    lock = tmp_path / "out" / "a" / ".lock"
    with no_orphans(tmp_path / "out"):
        for _ in range(2):
            processes.replace_worker(worker_of(lock, processes))
        output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, output + errors
    assert "a" in output and " ok " in output


@pytest.mark.slow
def test_a_storm_over_a_batch_ends_with_every_scene(tmp_path: Path) -> None:
    for scene in "abc":
        write_photos(tmp_path / "collection" / scene, 6)
    with no_orphans(tmp_path / "out"), DaskProcesses(2) as processes:
        storm = Storm(
            batch_command(tmp_path, "--dask", processes.address),
            processes, random.Random(os.getpid()), tmp_path / "out",
            pause=(0.5, 4.0), odds=(0.6, 0.2, 0.2), max_kills=15,
        )  # fmt: skip
        storm.run(600)
    assert storm.kills.total() >= 2
    assert not any("another corrsfm works" in error for error in storm.errors)
    assert len(list((tmp_path / "out").glob("*/report.json"))) == 3
