"""Documentation that cannot rot."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from corrsfm.cli import main
from tools.reference import REFERENCE_FILE


def readme_commands(repository: Path) -> list[str]:
    """Lines of the README's shell blocks that call corrsfm."""
    blocks = re.findall(
        r"```(?:bash|sh|console)\n(.*?)```", (repository / "README.md").read_text(), re.DOTALL
    )
    lines = [line.split("#")[0].strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith("corrsfm ")]


def test_command_line_reference_is_current(repository: Path) -> None:
    # In a process of its own: click remembers how a command's help was asked for first.
    code = "import sys; from tools.reference import render_reference; sys.stdout.write(render_reference())"
    result = subprocess.run(
        [sys.executable, "-X", "utf8", "-c", code], capture_output=True, check=True, cwd=repository
    )
    assert REFERENCE_FILE.read_text(encoding="utf-8") == result.stdout.decode(), "run: make reference"


def test_every_command_of_the_readme_parses(repository: Path) -> None:
    commands = readme_commands(repository)
    assert len(commands) >= 6
    for line in commands:
        words = line.split()[1:]
        depth = 2 if words[0] in ("evaluate", "train") else 1
        result = CliRunner().invoke(main, [*words[:depth], "--help"])
        assert result.exit_code == 0, line
        for flag in re.findall(r"(?<=\s)--[a-z][a-z-]*", line):
            assert flag in result.output, f"{flag} of '{line}' does not exist"


def test_readme_names_the_test_command_that_ci_calls(repository: Path) -> None:
    assert "make test" in (repository / "README.md").read_text()
    assert "make test" in (repository / ".ci" / "run").read_text()


def test_changelog_has_the_version_of_the_package(repository: Path) -> None:
    import corrsfm

    assert f"## [{corrsfm.__version__}]" in (repository / "CHANGELOG.md").read_text()


@pytest.mark.slow
def test_the_readmes_walk_through_works_on_a_sample_scene(repository: Path, tmp_path: Path) -> None:
    text = (repository / "README.md").read_text()
    block = re.search(r"<!-- walk-through -->\n```bash\n(.*?)```", text, re.DOTALL)
    assert block is not None
    script = block.group(1).replace("corrsfm ", f"{sys.executable} -m corrsfm ")
    script = script.replace("photos/", f"{repository}/sample_scenes/courtyard/images ")
    result = subprocess.run(["bash", "-euc", script], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "scene" / "sparse" / "0" / "images.bin").exists()
