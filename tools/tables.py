"""The tables of the project's documents, written from its result files.

    python tools/tables.py            # README.md and results/README.md
    python tools/tables.py --check    # change nothing; fail if one differs from its results

A document holds blocks between two comments; what is between them comes from ``results/NAME.json`` alone::

    <!-- table:NAME -->               all rows and columns
    <!-- /table -->

    <!-- table:NAME
    rows: CELL; CELL = what to show instead
    columns: HEADING; HEADING = what to show instead
    -->                               chosen ones, in this order; CELL is what the first column says
    <!-- /table -->

    <!-- command:NAME -->             one command that measures all of the file
    <!-- /command -->
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from corrsfm.errors import CorrsfmError, InputError
from corrsfm.evaluation.records import load_results
from corrsfm.evaluation.tables import Table, build_table
from corrsfm.files import atomic_write_text

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.house_tables import HOUSE_TABLES, draw_growth  # noqa: E402

__all__ = ["DOCUMENTS", "RESULTS_DIR", "choose", "main", "render_document", "update_document"]

_REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS_DIR = _REPOSITORY / "results"
DOCUMENTS = (_REPOSITORY / "README.md", RESULTS_DIR / "README.md")

_BLOCK = re.compile(
    r"(?P<start><!-- (?P<kind>table|command):(?P<name>[\w.-]+)(?P<choice>[^>]*?)-->\n)"
    r".*?(?P<end><!-- /(?P=kind) -->)",
    re.DOTALL,
)
_CHOICE = re.compile(r"^(rows|columns):", re.MULTILINE)
_COMMAND_WIDTH = 100


def _parse_choice(text: str, where: str) -> dict[str, dict[str, str]]:
    """What a marker chooses: for rows and columns their names → what to show."""
    before, *parts = _CHOICE.split(text)
    if before.strip():
        raise InputError(f"{where}: '{before.strip()}' is neither 'rows: …' nor 'columns: …'")
    chosen: dict[str, dict[str, str]] = {}
    for key, names in zip(parts[::2], parts[1::2], strict=True):
        chosen[key] = {}
        for entry in names.split(";"):
            name, _, label = (" ".join(part.split()) for part in entry.partition(" = "))
            chosen[key][name] = label or name
    return chosen


def _positions(wanted: Sequence[str], there: Sequence[str], where: str) -> list[int]:
    missing = [name for name in wanted if name not in there]
    if missing:
        raise InputError(f"{where}: no {', '.join(missing)}; there are {', '.join(there)}")
    return [there.index(name) for name in wanted]


def choose(table: Table, rows: dict[str, str], columns: dict[str, str], where: str) -> Table:
    """Some rows and columns of a table.

    Parameters
    ----------
    table : Table
    rows, columns : dict
        First cells, or headings, in the order wanted → what to show instead. Empty for all; the first column
        is always there.
    where : str
        What asks, for messages.

    Raises
    ------
    InputError
        If the table has no such row or column.
    """
    headings = {table.header[0]: table.header[0], **(columns or {name: name for name in table.header})}
    kept = _positions(list(headings), table.header, where)
    chosen = table.rows
    if rows:
        places = _positions(list(rows), [cells[0] for cells in table.rows], where)
        chosen = [[label, *table.rows[place][1:]] for place, label in zip(places, rows.values(), strict=True)]
    return Table(
        header=list(headings.values()),
        rows=[[cells[place] for place in kept] for cells in chosen],
        caption=table.caption,
    )


def _full_command(values: dict[str, Any]) -> list[str]:
    """The recorded command; of a file that may grow run by run, the last one with all methods."""
    words = shlex.split(values["provenance"]["command"])
    flag = {"pose": "--method", "homography": "--filter"}.get(values["kind"])
    if flag is None:
        return words
    rest = [
        word for position, word in enumerate(words) if flag not in words[max(position - 1, 0) : position + 1]
    ]
    return [*rest, *(word for name in values["methods"] for word in (flag, name))]


def _command_block(words: Sequence[str]) -> str:
    """A command as a shell block; long ones are folded, a flag and its value stay together."""
    parts: list[str] = []
    for word in words:
        is_value = bool(parts) and parts[-1].startswith("-") and " " not in parts[-1]
        if is_value and not word.startswith("-"):
            parts[-1] += f" {shlex.quote(word)}"
        else:
            parts.append(shlex.quote(word))
    lines = parts[:1]
    for part in parts[1:]:
        if len(lines[-1]) + len(part) > _COMMAND_WIDTH:
            lines.append("   ")
        lines[-1] += f" {part}"
    return "\n".join(["```bash", " \\\n".join(lines), "```"])


def render_document(text: str, results_dir: Path, *, where: str = "document") -> str:
    """A document with every block rendered from its result file.

    Parameters
    ----------
    text : str
    results_dir : Path
        Folder with ``NAME.json``.
    where : str
        The document's name, for messages.

    Raises
    ------
    InputError
        If a block has no result file, chooses what its file does not have, or is left open.
    """
    for kind in ("table", "command"):
        opened, closed = text.count(f"<!-- {kind}:"), text.count(f"<!-- /{kind} -->")
        if not opened == closed == sum(match["kind"] == kind for match in _BLOCK.finditer(text)):
            raise InputError(
                f"{where}: {opened} lines '<!-- {kind}:NAME -->' and {closed} lines '<!-- /{kind} -->'; "
                "they must alternate, each on a line of its own"
            )

    def replace(match: re.Match[str]) -> str:
        values = load_results(results_dir / f"{match['name']}.json")
        if match["kind"] == "command":
            content = _command_block(_full_command(values))
        else:
            marker = f"{where}, table:{match['name']}"
            chosen = _parse_choice(match["choice"], marker)
            build = HOUSE_TABLES.get(values["kind"], build_table)
            table = choose(build(values), chosen.get("rows", {}), chosen.get("columns", {}), marker)
            content = table.markdown()
        return f"{match['start']}{content}\n{match['end']}"

    return _BLOCK.sub(replace, text)


def update_document(path: Path, results_dir: Path, *, check: bool = False) -> bool:
    """Render the blocks of a document in place.

    Parameters
    ----------
    path : Path
    results_dir : Path
    check : bool
        Change nothing.

    Returns
    -------
    bool
        True if the document differed from its results.

    Raises
    ------
    InputError
        If the document is not readable or a block has no result file.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: not readable ({error.strerror})") from error
    rendered = render_document(text, results_dir, where=str(path))
    if rendered != text and not check:
        atomic_write_text(path, rendered)
    return rendered != text


def _update_picture(results_dir: Path, *, check: bool) -> list[str]:
    """Draw growth.svg; its path if it differed from its results."""
    path, source = results_dir / "growth.svg", results_dir / "growth.json"
    if not source.exists():
        return []
    drawn = draw_growth(load_results(source, "growth"))
    if path.exists() and path.read_text(encoding="utf-8") == drawn:
        return []
    if not check:
        atomic_write_text(path, drawn)
    return [str(path)]


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Write the tables of documents from result files.")
    parser.add_argument("documents", type=Path, nargs="*", default=DOCUMENTS, metavar="DOCUMENT")
    parser.add_argument("--results-dir", type=Path, default=RESULTS_DIR)
    parser.add_argument("--check", action="store_true", help="change nothing; fail if a table is not current")
    options = parser.parse_args(arguments)
    try:
        changed = [
            str(path)
            for path in options.documents
            if update_document(path, options.results_dir, check=options.check)
        ]
        changed += _update_picture(options.results_dir, check=options.check)
    except CorrsfmError as error:
        sys.exit(f"error: {error}")
    if changed and options.check:
        sys.exit(f"error: tables differ from their results in {', '.join(changed)}; run: make tables")
    for name in changed:
        print(f"{name}: tables written")


if __name__ == "__main__":
    main()
