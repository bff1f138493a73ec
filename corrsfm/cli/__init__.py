"""The command line: thin commands over the Python API."""

from __future__ import annotations

import logging
import os
import sys
from typing import Any

import click

from corrsfm import __version__
from corrsfm.cli.batch import batch
from corrsfm.cli.bench import bench
from corrsfm.cli.check import check
from corrsfm.cli.compare import compare
from corrsfm.cli.evaluate import evaluate
from corrsfm.cli.export import export
from corrsfm.cli.finished import add, localize
from corrsfm.cli.importing import import_
from corrsfm.cli.options import OVERWRITE_KEY, RESUME_KEY
from corrsfm.cli.signals import interruptible
from corrsfm.cli.stages import extract, match, pairs, prune, reconstruct, report, run
from corrsfm.cli.surroundings import (
    drop_bad_settings,
    guarded_streams,
    require_current_folder,
    told,
)
from corrsfm.cli.train import train
from corrsfm.errors import printable

__all__ = ["main"]


class _Handler(logging.Handler):
    """Log lines on standard error that do not tear progress bars."""

    def emit(self, record: logging.LogRecord) -> None:
        from tqdm import tqdm

        prefix = "" if record.levelno < logging.WARNING else f"{record.levelname.lower()}: "
        tqdm.write(prefix + printable(record.getMessage()), file=sys.stderr)


class _Commands(click.Group):
    """A group that lists its commands in the order of a reconstruction and turns errors into text."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def main(self, *args: Any, **kwargs: Any) -> Any:
        with guarded_streams(), interruptible():
            return super().main(*args, **kwargs)

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        with told(lambda: "run the same command again"):
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> Any:
        with told(lambda: _how_to_go_on(ctx)):
            return super().invoke(ctx)


def _how_to_go_on(ctx: click.Context) -> str:
    if ctx.meta.get(RESUME_KEY) is False:
        return "run the same command with --resume to go on"
    if ctx.meta.get(OVERWRITE_KEY):
        return "run the same command without --overwrite to go on; with it, all is done again"
    return "run the same command again to go on"


@click.group(
    cls=_Commands,
    # Both spellings of a flag are accepted: --max-features and --max_features.
    context_settings={
        "help_option_names": ["-h", "--help"],
        "token_normalize_func": lambda t: t.replace("_", "-"),
    },
)
@click.version_option(__version__)
@click.option("-q", "--quiet", is_flag=True, help="Say nothing but warnings and errors; no progress bars.")
@click.option("--attended", is_flag=True, hidden=True, help="End when standard input closes.")
def main(quiet: bool, attended: bool) -> None:
    """Structure from motion with learned correspondence pruning.

    `corrsfm run PHOTOS WORKSPACE` goes from a folder of photos to models and a report, in steps that are
    commands too; `corrsfm export WORKSPACE OUT --for TOOL` hands the result on. Finished work is kept: after
    an interruption or a changed option, run the same command again.
    """
    require_current_folder()
    drop_bad_settings()
    if attended:
        from corrsfm.machine import end_with_parent

        end_with_parent(sys.stdin.fileno())
    logger = logging.getLogger("corrsfm")
    logger.handlers = [_Handler()]
    logger.setLevel(logging.WARNING if quiet else logging.INFO)
    # A bar in a file is one long line of carriage returns.
    if quiet or not sys.stderr.isatty():
        # tqdm reads its defaults from the environment at import, which happens later.
        os.environ["TQDM_DISABLE"] = "1"


_COMMANDS = (
    run, extract, import_, pairs, match, prune, reconstruct, report, add, localize, export, check, batch,
    compare, evaluate, bench, train,
)  # fmt: skip
for _command in _COMMANDS:
    main.add_command(_command)
