"""Shared options: flags generated from the config dataclasses, and the ones every command has."""

from __future__ import annotations

import dataclasses
import functools
import json
import logging
import os
import typing
from collections.abc import Callable, Collection, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from corrsfm import config as cfg
from corrsfm.cli.sections import SectionedOption, section_of
from corrsfm.config.fields import flag_of
from corrsfm.disk import is_closed, opening
from corrsfm.errors import InputError, printable
from corrsfm.evaluation.scenes import DEFAULT_NUM_SEEDS
from corrsfm.files import RESULT_BEGINNING, require_replaceable, why_unusable

__all__ = [
    "OVERWRITE_KEY",
    "PATH",
    "RESUME_KEY",
    "WARNED_KEY",
    "config_options",
    "echo_json",
    "json_option",
    "overwrite_option",
    "pipeline_options",
    "recipe_options",
    "resuming_run_options",
    "run_options",
    "seeds_option",
    "usage_options",
]

# Set in the context of an invocation with --overwrite.
OVERWRITE_KEY = "corrsfm.overwrite"
# In the context of a command that goes on only with --resume: whether that was given.
RESUME_KEY = "corrsfm.resume"
# In the context, what was said of options before the command began.
WARNED_KEY = "corrsfm.warned"

_LONGEST_SHOWN = 80

logger = logging.getLogger("corrsfm")


class _PathType(click.Path):
    """A path as `Path`; refuses those at which nothing can be looked up, or that no list can hold."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        text = os.fspath(value)
        if is_closed(text):
            raise InputError(opening(Path(text)))
        if why := why_unusable(text):
            shown = text if len(text) <= _LONGEST_SHOWN else f"{text[:_LONGEST_SHOWN]}…"
            self.fail(f"'{printable(shown)}' {why}" if text else why, param, ctx)
        # Commands that are advised to paste would take such a name for an option.
        return super().convert(os.path.abspath(text) if text.startswith("-") else value, param, ctx)


PATH = _PathType(path_type=Path)
"""The type of every argument and option that is a path."""


class _OutputType(_PathType):
    """The path of a file to write, which may replace one of its kind, but no other."""

    def __init__(self, what: str, *beginnings: bytes) -> None:
        super().__init__(path_type=Path)
        self._kind = what, beginnings

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = super().convert(value, param, ctx)
        what, beginnings = self._kind
        require_replaceable(path, what, *beginnings)
        return path


CHECKPOINT_FILE = _OutputType("a checkpoint", b"PK")
CSV_FILE = _OutputType("a table of poses", b"name,")
PAIR_FILE = _OutputType("a file of labelled pairs", b"\x89HDF")
PNG_FILE = _OutputType("a PNG", b"\x89PNG")
RESULT_FILE = _OutputType("a result file", RESULT_BEGINNING)


F = typing.TypeVar("F", bound=Callable[..., Any])


def _option(entry: dataclasses.Field, annotation: Any, section: str, *, hidden: bool) -> Callable[[F], F]:
    """One click option for one config field, listed under a heading unless it is hidden."""
    flag = flag_of(entry.name)
    inner = next(
        (a for a in typing.get_args(annotation) if a is not type(None) and a is not Ellipsis), annotation
    )
    text = entry.metadata["help"]
    if unit := entry.metadata["unit"]:
        text += f" [{unit}]"
    settings: dict[str, Any] = {
        "cls": SectionedOption,
        "section": section,
        "hidden": hidden,
        "help": text + ".",
        "default": entry.default,
        "show_default": True,
    }
    if isinstance(entry.default, StrEnum):
        settings["default"] = str(entry.default)
    if annotation is bool:
        return click.option(f"{flag}/--no-{flag[2:]}", **settings)
    if isinstance(inner, type) and issubclass(inner, StrEnum):
        settings["type"] = click.Choice([str(member) for member in inner])
        if typing.get_origin(annotation) is tuple:
            defaults = typing.cast(tuple[StrEnum, ...], entry.default)
            settings |= {"multiple": True, "default": [str(member) for member in defaults]}
    elif inner is Path:
        several = typing.get_origin(annotation) is tuple
        settings |= {"type": PATH, "show_default": False, "multiple": several}
    elif inner in (int, float):
        settings["type"] = inner
    else:
        settings["show_default"] = bool(entry.default)
    return click.option(flag, entry.name, **settings)


def config_options(*, hidden: Collection[str] = (), **configs: type) -> Callable[[F], F]:
    """Give a command a flag for every field of the named config dataclasses.

    ``@config_options(features=FeaturesConfig)`` calls the command with ``features=FeaturesConfig(...)``. The
    help leaves out fields in ``hidden``.

    Raises
    ------
    ConfigError
        If a value is out of its range, naming all of them.
    """

    def decorate(command: F) -> F:
        @functools.wraps(command)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            if idle := [flag_of(name) for name in hidden if _is_typed(name)]:
                _warn_of(f"{', '.join(idle)}: no effect with this command")
            for keyword, cls in configs.items():
                kwargs[keyword] = _override(cls(), kwargs)
            return command(*args, **kwargs)

        return typing.cast(F, _with_flags(wrapped, configs.values(), hidden))

    return decorate


def pipeline_options(command: F, *, several_methods: bool = False) -> F:
    """``--pipeline FILE`` and a flag for every option of every stage.

    The command is called with ``config=PipelineConfig(...)``: the file's values, overridden by the flags that
    the user typed. One with ``several_methods`` prunes by others than the config's: no option of pruning is
    idle, and its help does not list ``--method``.
    """
    file_option = click.option(
        "--pipeline",
        "file",
        type=PATH,
        help="Pipeline file in TOML; flags typed here override it.",
    )
    tables = [entry.name for entry in dataclasses.fields(cfg.PipelineConfig)]
    used, hidden = (["prune"], ["method"]) if several_methods else ([], [])
    return file_option(
        _overriding(command, "config", cfg.PipelineConfig(), cfg.load_pipeline, tables, used, hidden)
    )


def recipe_options(command: F) -> F:
    """``--config FILE`` and a flag for every option of a training run.

    The command is called with ``recipe=TrainRecipe(...)``: the file's values, overridden by the flags that
    the user typed.
    """
    from corrsfm.training.config import TrainRecipe, load_recipe

    file_option = click.option(
        "--config",
        "file",
        type=PATH,
        help="Recipe in TOML (tables train, augment, synthetic, network); flags typed here override it.",
    )
    return file_option(_overriding(command, "recipe", TrainRecipe(), load_recipe, ["train"]))


def _overriding(
    command: F,
    keyword: str,
    default: Any,
    load: Callable[[Path], Any],
    tables: Sequence[str],
    used: Collection[str] = (),
    hidden: Collection[str] = (),
) -> F:
    """A command called with the config in its option ``file``, and flags that override some tables of it.

    Flags of the tables in ``used`` are never reported as idle; the help leaves out fields in ``hidden``.
    """

    @functools.wraps(command)
    def wrapped(*args: Any, file: Path | None, **kwargs: Any) -> Any:
        base = load(file) if file else default
        changed = {
            name: _override(getattr(base, name), kwargs, may_be_idle=name not in used) for name in tables
        }
        return command(*args, **{keyword: dataclasses.replace(base, **changed)}, **kwargs)

    return typing.cast(F, _with_flags(wrapped, [type(getattr(default, name)) for name in tables], hidden))


def _with_flags(command: Callable, configs: Collection[type], hidden: Collection[str] = ()) -> Callable:
    """Click options for every field of some config dataclasses, in order."""
    for cls in reversed(list(configs)):
        annotations = typing.get_type_hints(cls)
        for entry in reversed(dataclasses.fields(cls)):
            option = _option(entry, annotations[entry.name], section_of(cls), hidden=entry.name in hidden)
            command = option(command)
    return command


def _override(base: Any, values: dict[str, Any], *, may_be_idle: bool = True) -> Any:
    """A config with the flags that the user typed, which are taken out of ``values``, all checked.

    A warning names those without effect beside the others.
    """
    context = click.get_current_context()
    given = {}
    for entry in dataclasses.fields(base):
        value = values.pop(entry.name)
        if context.get_parameter_source(entry.name) is not ParameterSource.DEFAULT:
            given[entry.name] = value
    checked = cfg.from_dict(type(base), given, "command line")
    config = dataclasses.replace(base, **{name: getattr(checked, name) for name in given})
    if may_be_idle:
        _warn_of_idle(config, given)
    return config


def _warn_of_idle(config: Any, given: Collection[str]) -> None:
    """Warn of given options that have no effect with the choice of another option."""
    idle: dict[str, list[str]] = {}
    for entry in dataclasses.fields(config):
        if entry.name not in given or entry.metadata["used_with"] is None:
            continue
        chooser, choices = entry.metadata["used_with"]
        chosen = getattr(config, chooser)
        chosen = chosen if isinstance(chosen, tuple) else (chosen,)
        if not set(chosen) & set(choices):
            idle.setdefault(f"--{chooser} {'+'.join(chosen)}", []).append(flag_of(entry.name))
    for choice, flags in idle.items():
        _warn_of(f"{', '.join(flags)}: no effect with {choice}")


def _warn_of(text: str) -> None:
    logger.warning("%s", text)
    click.get_current_context().meta.setdefault(WARNED_KEY, []).append(text)


def _is_typed(name: str) -> bool:
    return click.get_current_context().get_parameter_source(name) is ParameterSource.COMMANDLINE


def run_options(command: F) -> F:
    """``--seed``, ``--device`` and ``--threads``; the command is called with ``run=RunConfig(...)``."""
    return config_options(hidden=("verify", "cluster", "workers"), run=cfg.RunConfig)(command)


def resuming_run_options(command: F) -> F:
    """`run_options`, ``--verify``, ``--cluster`` and ``--workers``, for commands that make and keep items."""
    return config_options(run=cfg.RunConfig)(command)


def usage_options(command: F) -> F:
    """A flag for every field of a checkpoint's usage.

    The command is called with ``adjust``, which overrides a `NetworkUsage` by the flags that the user typed.
    """
    names = [entry.name for entry in dataclasses.fields(cfg.NetworkUsage)]

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        values = {name: kwargs.pop(name) for name in names}
        return command(*args, adjust=lambda usage: _override(usage, dict(values)), **kwargs)

    return typing.cast(F, _with_flags(wrapped, [cfg.NetworkUsage]))


def overwrite_option(command: F) -> F:
    """``--overwrite``; without it finished work is kept."""

    def note(context: click.Context, _: click.Parameter, value: bool) -> bool:
        context.meta[OVERWRITE_KEY] = value
        return value

    return click.option(
        "--overwrite",
        is_flag=True,
        callback=note,
        help="Redo finished work; without it only what is missing or stale is done.",
    )(command)


def seeds_option(command: F) -> F:
    """``--seeds``; the command is called with ``num_seeds``."""
    return click.option(
        "--seeds",
        "num_seeds",
        type=click.IntRange(min=1),
        default=DEFAULT_NUM_SEEDS,
        show_default=True,
        help="Seeds to map with, for the median and the worst; 1 is quick, but one draw.",
    )(command)


def json_option(command: F) -> F:
    """``--json``; the command is called with ``as_json``."""
    return click.option(
        "--json", "as_json", is_flag=True, help="Print the result as JSON on standard output."
    )(command)


def echo_json(value: Any) -> None:
    """Print a value as JSON on standard output."""
    click.echo(json.dumps(value, indent=2, ensure_ascii=False, default=str))
