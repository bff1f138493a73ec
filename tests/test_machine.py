"""What this process runs on."""

import os
import platform
import signal
import subprocess
import sys
import threading

import pytest
import torch

from corrsfm.errors import ConfigError
from corrsfm.machine import count_threads, find_device, threaded, versions


def test_devices_that_exist_keep_their_name() -> None:
    assert find_device("cpu") == "cpu"
    assert find_device("auto") == ("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("name", ["tpu9x", "cuda:77", ""])
def test_a_device_that_is_not_there_is_an_error_that_names_it(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"--device {name}: torch .* cannot use it here \(.+try auto, cpu"):
        find_device(name)


@pytest.mark.parametrize("name", ["gpu", "meta"])
def test_the_message_about_a_device_does_not_list_all_that_torch_knows(name: str) -> None:
    with pytest.raises(ConfigError) as caught:
        find_device(name)
    assert len(str(caught.value)) < 150


def test_zero_threads_means_all_that_the_process_may_have() -> None:
    assert count_threads(3) == 3
    assert 1 <= count_threads(0) <= (os.cpu_count() or 1)


def test_threaded_work_comes_back_in_order_and_is_not_far_ahead() -> None:
    started = []
    first_may_end = threading.Event()

    def work(key: int) -> int:
        started.append(key)
        if key == 0:
            first_may_end.wait(5)
        return key * key

    results = threaded(work, range(100), 2)
    threading.Timer(0.05, first_may_end.set).start()
    assert next(results) == (0, 0)
    assert max(started) < 4
    assert list(results) == [(key, key * key) for key in range(1, 100)]


def test_versions_name_what_is_installed_and_nothing_else() -> None:
    found = versions(["numpy", "no-such-package-here"])
    assert list(found) == ["corrsfm", "python", "numpy"]


def test_a_process_ends_with_the_one_that_holds_its_pipe() -> None:
    code = "import time; from corrsfm.machine import end_with_parent; end_with_parent(0); time.sleep(60)"
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(1)
    process.communicate()
    assert process.returncode == -signal.SIGKILL


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc is told to keep freed memory")
def test_freed_memory_is_taken_again_and_not_given_back() -> None:
    def new_pages(first: str) -> int:
        """Pages that a process gets from the system while it takes and frees 8 MiB ten times more."""
        code = (
            f"import resource\n{first}\n"
            "def take():\n    [bytearray(2**20) for _ in range(8)]\n"
            "def pages():\n    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
            "take()\nbefore = pages()\nfor _ in range(10):\n    take()\nprint(pages() - before)\n"
        )
        return int(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout)

    kept = new_pages("from corrsfm.machine import keep_freed_memory\nkeep_freed_memory()")
    assert kept < new_pages("") / 10
