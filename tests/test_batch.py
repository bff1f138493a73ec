"""Many scenes: what a batch says of each, how they share the machine, and how it ends."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from photos import write_photos

from corrsfm import batch
from corrsfm.batch import SceneStatus, find_scenes, run_collection, run_one
from corrsfm.cli import main
from corrsfm.cli.batch import _with_absolute_paths
from corrsfm.errors import InputError, WorkspaceError
from corrsfm.report import make_report


def collection(root: Path, *scenes: str) -> Path:
    for scene in scenes:
        (root / "collection" / scene).mkdir(parents=True)
        (root / "collection" / scene / "0.jpg").touch()
    return root / "collection"


def stand_in(root: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Let a shell script, called like Python, take the place of the scenes' processes."""
    path = root / "stand-in"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(path))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_batch_ends_its_scenes_and_starts_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    stand_in(tmp_path, monkeypatch, 'echo $$ > "$7.pid"; exec sleep 60')
    out = tmp_path / "out"

    def interrupt() -> None:
        while not all((out / f"{scene}.pid").exists() for scene in "ab") and time.monotonic() < started + 20:
            time.sleep(0.02)
        os.kill(os.getpid(), number)

    before = signal.getsignal(signal.SIGTERM)
    started = time.monotonic()
    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        run_collection(collection(tmp_path, *"abcd"), out, jobs=2)
    assert time.monotonic() - started < 30
    assert signal.getsignal(signal.SIGTERM) == before
    assert sorted(path.name for path in out.glob("*.pid")) == ["a.pid", "b.pid"]
    for path in out.glob("*.pid"):
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.read_text()), 0)


@pytest.mark.parametrize(
    ("arguments", "jobs", "given"),
    [
        ([], 1, []),
        ([], 2, ["--threads", "4"]),
        ([], 3, ["--threads", "2"]),
        (["--seed", "1"], 99, ["--threads", "2", "--seed", "1"]),
        (["--threads", "5"], 2, ["--threads", "5"]),
        (["--threads=5"], 2, ["--threads=5"]),
        (["--pipeline", "chosen.toml"], 2, ["--pipeline", "chosen.toml"]),
        (["--pipeline=open.toml"], 2, ["--threads", "4", "--pipeline=open.toml"]),
    ],
)
def test_scenes_at_a_time_share_the_cores_unless_told_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], jobs: int, given: list[str]
) -> None:
    monkeypatch.setattr(batch, "count_threads", lambda wanted: wanted or 8)
    monkeypatch.chdir(tmp_path)
    Path("chosen.toml").write_text("[run]\nthreads = 3\n")
    Path("open.toml").write_text("[run]\nseed = 3\n")
    stand_in(tmp_path, monkeypatch, 'shift 8; echo "$@" > "$0.$$"')
    statuses = run_collection(collection(tmp_path, *"abc"), tmp_path / "out", arguments, jobs=jobs)
    assert [(status.scene, status.succeeded) for status in statuses] == [(s, True) for s in "abc"]
    assert [path.read_text().split() for path in tmp_path.glob("stand-in.*")] == [given] * 3


def test_an_empty_folder_is_passed_over_unless_a_list_names_photos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(tmp_path, monkeypatch, "exit 0")
    monkeypatch.chdir(tmp_path)
    root = collection(tmp_path, "a")
    (root / "empty").mkdir()
    Path("plain.toml").write_text("[run]\nseed = 3\n")
    Path("list.toml").write_text("[images]\nimage_list = 'list.txt'\n")
    for name, is_empty in (("plain.toml", True), ("list.toml", False)):
        statuses = run_collection(root, tmp_path / "out", ["--pipeline", name])
        assert {status.scene: status.empty for status in statuses} == {"a": False, "empty": is_empty}


def test_the_statistics_are_the_numbers_of_the_reports_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = make_report(scene="a", image_names=["0.png", "1.png"], pairs=[], models=[])
    (tmp_path / "out" / "a").mkdir(parents=True)
    (tmp_path / "out" / "a" / "report.json").write_text(json.dumps(report.to_dict()))
    stand_in(tmp_path, monkeypatch, "exit 0")
    (status,) = run_collection(collection(tmp_path, "a"), tmp_path / "out")
    assert status.statistics["num_images"] == 2
    assert status.statistics["num_registered"] == status.statistics["num_models"] == 0
    assert "format_version" not in status.statistics


def test_the_message_is_the_whole_last_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(
        tmp_path,
        monkeypatch,
        "printf 'warning: x\\nError: old\\nError: 1.png: empty\\n2.png: cut\\n'; exit 1",
    )
    (status,) = run_collection(collection(tmp_path, "a"), tmp_path / "out")
    assert not status.succeeded
    assert status.message == "Error: 1.png: empty\n2.png: cut"


@pytest.mark.parametrize(
    ("script", "message"), [("echo Killed; exit 9", "Killed"), ("exit 9", "ended with code 9")]
)
def test_without_an_error_the_message_is_what_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, message: str
) -> None:
    stand_in(tmp_path, monkeypatch, script)
    (status,) = run_collection(collection(tmp_path, "a"), tmp_path / "out")
    assert status.message == message


def test_a_folder_without_photos_is_empty_and_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(tmp_path, monkeypatch, 'echo "$7" >> "$0.called"')
    root = collection(tmp_path, "notes", "phone", "photos")
    (root / "notes" / "0.jpg").rename(root / "notes" / "0.txt")
    (root / "phone" / "0.jpg").rename(root / "phone" / "0.HEIC")
    statuses = run_collection(root, tmp_path / "out")
    assert [(status.empty, status.succeeded, status.failed) for status in statuses] == [
        (True, False, False),
        (False, True, False),
        (False, True, False),
    ]
    assert str(statuses[0]).split() == ["notes", "empty", "0.0", "s", "no", "photos"]
    called = (tmp_path / "stand-in.called").read_text().split()
    assert called == [str(tmp_path / "out" / scene) for scene in ("phone", "photos")]
    result = CliRunner().invoke(main, ["batch", str(root), str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    shutil.rmtree(root / "phone")
    shutil.rmtree(root / "photos")
    result = CliRunner().invoke(main, ["batch", str(root), str(tmp_path / "out")])
    assert result.exit_code == 1
    assert "no photos in any of 1 folders" in result.output


def test_every_scene_that_ends_is_a_line_of_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    stand_in(tmp_path, monkeypatch, 'test "${7%b}" = "$7"')
    caplog.set_level("INFO", "corrsfm")
    run_collection(collection(tmp_path, *"ab"), tmp_path / "out")
    begun, *ended = [" ".join(message.split()[:3]) for message in caplog.messages]
    assert begun == "scenes to do:"
    assert [line.split()[0] for line in ended] == ["[1/2]", "[2/2]"]
    # They run side by side, and either may end first.
    assert sorted(line.split(maxsplit=1)[1] for line in ended) == ["a ok", "b FAILED"]


def test_what_befalls_a_scene_is_its_row_and_the_others_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(tmp_path, monkeypatch, "exit 0")
    # No log can be written where a folder has its name.
    (tmp_path / "out" / "b.batch.log").mkdir(parents=True)
    monkeypatch.setattr(batch, "holds_pictures", lambda folder: 1 // len(folder.name.strip("c")))
    statuses = run_collection(collection(tmp_path, *"abcd"), tmp_path / "out")
    assert [status.succeeded for status in statuses] == [True, False, False, True]
    assert statuses[1].message.endswith(
        "b.batch.log: cannot be written (Is a directory); the scene was not run"
    )
    assert statuses[2].message.startswith("Error: ZeroDivisionError: ")


def test_a_collection_is_not_its_own_output(tmp_path: Path) -> None:
    photos = collection(tmp_path, *"ab")
    with pytest.raises(InputError, match=r"is the collection itself; choose another folder, such as .*/out$"):
        run_collection(photos, tmp_path / "collection" / ".." / "collection")
    assert sorted(path.name for path in photos.iterdir()) == ["a", "b"]


def test_a_pipe_in_place_of_a_log_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, "exit 0")
    (tmp_path / "out").mkdir()
    os.mkfifo(tmp_path / "out" / "a.batch.log")
    statuses = run_collection(collection(tmp_path, *"ab"), tmp_path / "out")
    assert [status.succeeded for status in statuses] == [False, True]
    assert "a.batch.log: cannot be written (" in statuses[0].message


def test_a_link_in_place_of_a_log_is_not_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, "exit 0")
    (tmp_path / "diary").write_text("precious")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.batch.log").symlink_to(tmp_path / "diary")
    (status,) = run_collection(collection(tmp_path, "a"), tmp_path / "out")
    assert not status.succeeded and "a.batch.log: cannot be written (is a link)" in status.message
    assert (tmp_path / "diary").read_text() == "precious"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["extra"], "extra: expected options of corrsfm run"),
        (["--method", "ratio", "more", "words"], "more, words: expected options"),
        (["--bogus"], "No such option '--bogus'"),
        (["--max-features", "x"], "'x' is not a valid integer"),
    ],
)
def test_words_that_no_run_would_take_are_refused_before_any_scene(
    tmp_path: Path, words: list[str], text: str
) -> None:
    photos, output = collection(tmp_path, "a"), tmp_path / "out"
    result = CliRunner().invoke(main, ["batch", str(photos), str(output), *words])
    assert result.exit_code == 2 and text in result.stderr
    assert not output.exists()


def test_workers_are_told_where_files_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("my.pt", "my.toml"):
        Path(name).touch()
    Path("masks").mkdir()
    given = ("--model", "my.pt", "--pipeline=my.toml", "--mask-dir", "masks", "--method", "masks")
    assert _with_absolute_paths((*given, "--model", "small-mutual", "--threads", "1")) == (
        "--model", f"{tmp_path}/my.pt", f"--pipeline={tmp_path}/my.toml", "--mask-dir", f"{tmp_path}/masks",
        "--method", "masks", "--model", "small-mutual", "--threads", "1",
    )  # fmt: skip


def test_a_pipeline_that_no_run_would_take_is_refused_before_any_scene(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text("[prune]\nmethod = 7\n")
    photos, output = collection(tmp_path, "a"), tmp_path / "out"
    for name in ("mine.toml", "none.toml"):
        words = ["batch", str(photos), str(output), "--pipeline", str(tmp_path / name)]
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 1 and f"{tmp_path / name}: " in result.stderr
    assert not output.exists()


def test_a_scene_that_was_killed_is_told_from_one_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(tmp_path, monkeypatch, "echo half a line; kill -9 $$")
    root = collection(tmp_path, "a")
    (status,) = run_collection(root, tmp_path / "out")
    assert status.message.startswith("Error: killed (SIGKILL, as when memory runs out: ")
    stand_in(tmp_path, monkeypatch, "kill -15 $$")
    (status,) = run_collection(root, tmp_path / "out")
    assert status.message == "Error: killed (SIGTERM); run the same command again"


def test_a_scene_that_cannot_be_started_is_its_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "nothing"))
    statuses = run_collection(collection(tmp_path, "a", "b"), tmp_path / "out")
    assert [status.failed for status in statuses] == [True, True]
    assert statuses[0].message.startswith("Error: FileNotFoundError: ")


def test_links_that_lead_nowhere_end_no_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, monkeypatch, "exit 0")
    root = collection(tmp_path, "a")
    for name, target in (("loop", "loop"), ("dangling", "nowhere")):
        (root / name).symlink_to(target)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a").symlink_to("a")
    statuses = run_collection(root, tmp_path / "out")
    assert [(status.scene, status.succeeded) for status in statuses] == [("a", True)]


def test_what_a_killed_batch_was_doing_ends_with_it_and_the_next_one_goes_on(tmp_path: Path) -> None:
    write_photos(tmp_path / "collection" / "a", 4)
    words = [str(tmp_path / "collection"), str(tmp_path / "out"), "--max-features", "500", "--device", "cpu"]
    command = [sys.executable, "-m", "corrsfm", "batch", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    lock, deadline = tmp_path / "out" / "a" / ".lock", time.monotonic() + 60
    while not (lock.exists() and lock.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.02)
    holder = json.loads(lock.read_text())["process"]
    process.kill()
    process.wait()
    while time.monotonic() < deadline:
        try:
            os.kill(holder, 0)
        except ProcessLookupError:
            break
        time.sleep(0.02)
    else:
        pytest.fail(f"process {holder} goes on")
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert " ok " in result.stdout


def test_an_output_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "out").touch()
    with pytest.raises(WorkspaceError, match=r"out: cannot be made \(.*\); or choose another folder"):
        run_collection(collection(tmp_path, "a"), tmp_path / "out")


def test_an_unreadable_photo_is_named(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 3)
    (tmp_path / "photos" / "1.png").write_bytes(b"")
    status = run_one(
        "a", str(tmp_path / "photos"), str(tmp_path / "a"), ["--threads", "1", "--device", "cpu"]
    )
    assert status.message.startswith("Error: ")
    assert "1.png: the file is empty" in status.message


def test_workspaces_inside_the_collection_are_no_scene(tmp_path: Path) -> None:
    root = collection(tmp_path, "a", "out")
    assert list(find_scenes(root)) == ["a", "out"]
    assert list(find_scenes(root, leave_out=root / "a" / ".." / "out")) == ["a"]


def test_the_output_of_another_batch_is_no_scene(tmp_path: Path) -> None:
    root = collection(tmp_path, "a", "b")
    workspace = root / "b" / "corrsfm"
    for folder in (root / "out" / "a", workspace):
        folder.mkdir(parents=True)
        (folder / "workspace.json").touch()
    (root / "out" / "a.batch.log").touch()
    # The photos of a scene may have the workspace beside them.
    assert list(find_scenes(root)) == ["a", "b"]


def test_a_scene_is_one_line_whatever_its_name() -> None:
    status = SceneStatus(scene="a\nb\x85\r", succeeded=True, seconds=1.0)
    assert str(status).splitlines() == [str(status)]


def stand_ins(root: Path, *names: str) -> dict[str, str]:
    """An environment where commands write their names and arguments to `calls`."""
    (root / "bin").mkdir()
    for name in names:
        script = root / "bin" / name
        script.write_text(f'#!/bin/sh\necho {name} "$@" >> "{root}/calls"\n')
        script.chmod(0o755)
    return {"PATH": f"{root / 'bin'}:{os.environ['PATH']}", "SLURM_CPUS_PER_TASK": "8"}


def test_a_slurm_job_of_one_scene_starts_workers_on_every_node(repository: Path, tmp_path: Path) -> None:
    environment = stand_ins(tmp_path, "dask", "srun", "corrsfm", "hostname")
    (tmp_path / "bin" / "hostname").write_text("#!/bin/sh\necho node1\n")
    # When the run ends, so do scheduler and workers; on a busy machine they have not begun by then.
    (tmp_path / "bin" / "corrsfm").write_text(
        f'#!/bin/sh\nfor i in $(seq 200); do [ "$(wc -l < "{tmp_path}/calls")" -ge 2 ] && break; sleep 0.1; '
        f'done\necho corrsfm "$@" >> "{tmp_path}/calls"\n'
    )
    subprocess.run(
        ["bash", str(repository / "pipelines" / "scene.slurm"), "my photos", "out", "--method", "ratio"],
        env=environment | {"SLURM_JOB_ID": "10007"}, check=True,
    )  # fmt: skip
    deadline = time.monotonic() + 20
    while len(calls := (tmp_path / "calls").read_text().splitlines()) < 3 and time.monotonic() < deadline:
        time.sleep(0.05)
    assert sorted(calls) == [
        "corrsfm run my photos out --cluster tcp://node1:30007 --wait --method ratio",
        "dask scheduler --port 30007 --no-dashboard",
        "srun dask worker tcp://node1:30007 --nthreads 8 --memory-limit 0 --no-dashboard",
    ]


def test_a_job_of_the_slurm_array_runs_the_scene_of_its_number(repository: Path, tmp_path: Path) -> None:
    for scene in ("a", "b c", "d"):
        (tmp_path / "collection" / scene / "images").mkdir(parents=True)
    stand_in = tmp_path / "bin" / "corrsfm"
    stand_in.parent.mkdir()
    stand_in.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    stand_in.chmod(0o755)
    result = subprocess.run(
        [
            "bash",
            str(repository / "pipelines" / "collection.slurm"),
            "collection",
            "out",
            "--method",
            "ratio",
        ],
        cwd=tmp_path,
        env={
            "PATH": f"{stand_in.parent}:{os.environ['PATH']}",
            "SLURM_ARRAY_TASK_ID": "1",
            "SLURM_CPUS_PER_TASK": "8",
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.splitlines() == [
        "run", "collection/b c/images", "out/b c", "--threads", "8", "--wait", "--method", "ratio",
    ]  # fmt: skip
