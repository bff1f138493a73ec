"""The command-line reference: the captured help of every command, kept as a file so that it cannot rot.

``python -m corrsfm.cli.reference`` writes it anew; a test compares.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click

__all__ = ["REFERENCE_FILE", "render_reference"]

REFERENCE_FILE = Path(__file__).with_name("REFERENCE.md")


def _commands(command: click.Command, context: click.Context) -> Iterator[click.Context]:
    yield context
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            child = command.get_command(context, name)
            assert child is not None
            yield from _commands(child, click.Context(child, info_name=name, parent=context))


def render_reference() -> str:
    """The reference as Markdown."""
    from corrsfm.cli import main

    settings = {**main.context_settings, "terminal_width": 100, "max_content_width": 100}
    root = click.Context(main, info_name="corrsfm", **settings)
    sections = [
        f"## {context.command_path}\n\n```\n{context.get_help()}\n```\n" for context in _commands(main, root)
    ]
    return "# Command-line reference\n\nWritten by `make reference`.\n\n" + "\n".join(sections)


if __name__ == "__main__":
    REFERENCE_FILE.write_text(render_reference(), encoding="utf-8")
