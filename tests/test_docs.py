"""Documentation stays true: commands parse, paths exist, Python imports, the walk-through runs."""

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

import corrsfm
from corrsfm.cli import main
from tools.reference import REFERENCE_FILE

DOCUMENTS = ["README.md", "CONTRIBUTING.md", "docs/guide.md", "results/README.md"]
MOST_README_LINES = 115

each_document = pytest.mark.parametrize("document", DOCUMENTS)


def blocks_of(text: str, language: str) -> list[str]:
    """The code blocks of a Markdown text in one language."""
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def shell_lines(text: str) -> list[str]:
    """Commands of the shell blocks: continued lines joined, comments dropped."""
    lines = [line for block in blocks_of(text, "bash") for line in block.replace("\\\n", " ").splitlines()]
    return [" ".join(line.split("#")[0].split()) for line in lines]


def find_command(words: list[str]) -> tuple[list[str], click.Command]:
    """The command that words of a shell line call, and the words that name it."""
    command: click.Command = main
    named = []
    for word in words:
        if not isinstance(command, click.Group) or word.startswith("-"):
            break
        assert word in command.commands, f"no command '{word}'"
        command = command.commands[word]
        named.append(word)
    return named, command


def paths_in(text: str) -> Iterator[str]:
    """Targets of links to files, and code in backquotes that reads like a path of the repository."""
    yield from (t for t in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text) if "://" not in t)
    prose = re.sub(r"```.*?```|<!--.*?-->", "", text, flags=re.DOTALL)
    folders = "corrsfm|tests|tools|docs|results|pipelines|sample_scenes"
    yield from re.findall(rf"`((?:{folders})/[\w./*-]*|\w+\.(?:md|cff|toml))`", prose)


def test_command_line_reference_is_current(repository: Path) -> None:
    # In a process of its own: click remembers how a command's help was asked for first.
    code = "import sys; from tools.reference import render_reference; sys.stdout.write(render_reference())"
    result = subprocess.run(
        [sys.executable, "-X", "utf8", "-c", code], capture_output=True, check=True, cwd=repository
    )
    assert REFERENCE_FILE.read_text(encoding="utf-8") == result.stdout.decode(), "run: make reference"


def test_every_command_of_the_documents_parses(repository: Path) -> None:
    lines = [
        line
        for document in DOCUMENTS
        for line in shell_lines((repository / document).read_text(encoding="utf-8"))
        if line.startswith("corrsfm ")
    ]
    assert len(lines) >= 20
    for line in lines:
        words = [word for word in line.split()[1:] if word != "-q"]
        named, command = find_command(words)
        known = {
            flag for parameter in command.params for flag in (*parameter.opts, *parameter.secondary_opts)
        }
        if named == ["batch"]:
            known |= {flag for parameter in main.commands["run"].params for flag in parameter.opts}
        for word in words:
            if word.startswith("-"):
                assert word in known, f"{word} of '{line}' does not exist"


@each_document
def test_every_path_that_a_document_names_exists(repository: Path, document: str) -> None:
    text = (repository / document).read_text(encoding="utf-8")
    paths = set(paths_in(text))
    assert len(paths) >= 4
    # Links are relative to the document, paths in backquotes to the repository; recipes lie in pipelines/.
    places = [(repository / document).parent, repository, repository / "pipelines"]
    missing = [path for path in sorted(paths) if not any(list(place.glob(path)) for place in places)]
    assert not missing, f"{document} names {missing}"


@each_document
def test_every_link_within_a_document_has_its_heading(repository: Path, document: str) -> None:
    text = (repository / document).read_text(encoding="utf-8")
    headings = {
        re.sub(r"[^\w -]", "", h).lower().replace(" ", "-") for h in re.findall(r"^#+ (.+)$", text, re.M)
    }
    assert set(re.findall(r"\]\(#([^)]+)\)", text)) <= headings


@each_document
def test_every_make_target_that_a_document_names_exists(repository: Path, document: str) -> None:
    makefile = (repository / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", makefile, re.MULTILINE))
    assert {"demo", "test", "test-slow", "lint", "format", "reference", "tables", "clean"} <= targets
    text = (repository / document).read_text(encoding="utf-8")
    code = "\n".join([*blocks_of(text, "bash"), *re.findall(r"`([^`\n]+)`", text)])
    assert set(re.findall(r"(?:^|\s)make ([a-z-]+)", code)) <= targets


@each_document
def test_python_of_a_document_compiles_and_its_imports_exist(repository: Path, document: str) -> None:
    for block in blocks_of((repository / document).read_text(encoding="utf-8"), "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(str(node.module))
                assert all(hasattr(module, alias.name) for alias in node.names), ast.unparse(node)


def test_documents_with_python_were_found(repository: Path) -> None:
    found = [d for d in DOCUMENTS if blocks_of((repository / d).read_text(encoding="utf-8"), "python")]
    assert found == ["README.md", "docs/guide.md"]


def test_the_front_page_is_short_and_shows_a_picture_and_one_table_of_results(repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MOST_README_LINES
    assert re.search(r"^!\[.{20,}\]\(\S+\.png\)$", text, re.MULTILINE)
    assert text.count("<!-- table:") == 1


def test_the_front_page_clones_what_the_project_calls_its_home(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    home = project["urls"]["Homepage"]
    assert all(url.startswith("https://") for url in project["urls"].values())
    lines = shell_lines((repository / "README.md").read_text(encoding="utf-8"))
    assert f"git clone {home} && cd {home.rsplit('/', 1)[1]}" in lines
    assert f'repository-code: "{home}"' in (repository / "CITATION.cff").read_text(encoding="utf-8")


def test_every_stage_is_on_the_map_of_the_front_page_in_order(repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| ", text, re.MULTILINE)
    stages = {path.parent.name for path in (repository / "corrsfm").glob("*/stage.py")}
    assert len(stages) == 8
    assert [row for row in rows if row in stages] == [
        "images", "features", "pairs", "matches", "prune", "database", "reconstruction", "report",
    ]  # fmt: skip


def test_every_prune_method_is_on_the_front_page(repository: Path) -> None:
    from corrsfm.config import PruneMethod

    text = (repository / "README.md").read_text(encoding="utf-8")
    table = text[text.index("| `--method` |") :].split("\n\n")[0]
    explained = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    need_nothing = [str(one) for one in PruneMethod if one.architecture is None or one.bundled]
    assert sorted(explained) == sorted(need_nothing)
    assert all(f"`{method}`" in text for method in PruneMethod)


def test_the_citation_has_what_the_format_asks_for(repository: Path) -> None:
    text = (repository / "CITATION.cff").read_text(encoding="utf-8")
    values = dict(re.findall(r"^([a-z-]+): *(.*)$", text, re.MULTILINE))
    assert {"cff-version", "message", "title", "authors", "references"} <= values.keys()
    assert values["cff-version"] == "1.2.0"
    assert values["version"] == corrsfm.__version__
    # Spaces, not tabs; two at a time; every line a key, an item or both.
    for line in text.splitlines():
        assert re.fullmatch(r"(  )*(- )?([a-z-]+:( .+)?|[\w -]+)", line), line
    names = re.findall(r"family-names: (\w+)\n +given-names: (\w)", text)
    readme = (repository / "README.md").read_text(encoding="utf-8").replace("\n", " ")
    *most, last = [f"{initial}. {name}" for name, initial in names]
    assert f"{', '.join(most)} and {last}" in readme
    assert "arXiv:2408.08134" in text and "2408.08134" in readme


def test_ci_calls_what_the_documents_tell_people_to_call(repository: Path) -> None:
    lines = (repository / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if line.startswith("make ")] == [
        "make lint", "make test", "make test-slow", "make demo",
    ]  # fmt: skip
    assert {"make test", "make test-slow", "make lint"} <= set(
        shell_lines((repository / "CONTRIBUTING.md").read_text(encoding="utf-8"))
    )


def test_changelog_has_the_version_of_the_package(repository: Path) -> None:
    assert f"## [{corrsfm.__version__}]" in (repository / "CHANGELOG.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_readmes_walk_through_works_on_a_sample_scene(repository: Path, tmp_path: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    block = re.search(r"<!-- walk-through -->\n```bash\n(.*?)```", text, re.DOTALL)
    assert block is not None
    script = block.group(1).replace("corrsfm ", f"{sys.executable} -m corrsfm ")
    script = script.replace("photos/", f"{repository}/sample_scenes/courtyard/images ")
    result = subprocess.run(["bash", "-euc", script], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "scene" / "sparse" / "0" / "images.bin").exists()
    assert (tmp_path / "scene" / "report.html").exists()
    assert (tmp_path / "splat" / "sparse" / "0" / "cameras.bin").exists()
    assert (tmp_path / "nerf" / "transforms.json").exists()
