import signal
import subprocess
import sys


def test_termination_is_quiet():
    code = "import os, signal, corrsfm.colmap; os.kill(os.getpid(), signal.SIGTERM)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert done.returncode == -signal.SIGTERM
    assert done.stderr == b""
