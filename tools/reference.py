"""The command-line reference: the help of every command, captured so that it cannot go out of date.

    python tools/reference.py

writes `docs/reference.md`; a test compares the file with the help.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click

from corrsfm.cli import main

__all__ = ["REFERENCE_FILE", "render_reference"]

REFERENCE_FILE = Path(__file__).resolve().parents[1] / "docs" / "reference.md"


def _commands(command: click.Command, context: click.Context) -> Iterator[click.Context]:
    yield context
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            child = command.get_command(context, name)
            assert child is not None
            yield from _commands(child, click.Context(child, info_name=name, parent=context))


def render_reference() -> str:
    """The reference as Markdown."""
    settings = {**main.context_settings, "terminal_width": 100, "max_content_width": 100}
    root = click.Context(main, info_name="corrsfm", **settings)
    sections = [
        f"## {context.command_path}\n\n```\n{context.get_help()}\n```\n" for context in _commands(main, root)
    ]
    return "# Command-line reference\n\nWritten by `make reference`.\n\n" + "\n".join(sections)


if __name__ == "__main__":
    REFERENCE_FILE.write_text(render_reference(), encoding="utf-8")
