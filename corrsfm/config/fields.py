"""Fields of config dataclasses: help, bounds and flags, and plain values to a config and back."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import tomllib
import types
import typing
from enum import StrEnum
from json.encoder import encode_basestring_ascii
from pathlib import Path
from typing import Any, TypeVar

from corrsfm.errors import ConfigError, InputError
from corrsfm.files import read_text, sha256_of, why_unusable

__all__ = [
    "LARGEST_INT",
    "absolute",
    "config_hash",
    "encoded",
    "flag_of",
    "flags_of",
    "from_dict",
    "hash_encoded",
    "hash_of_content",
    "load_toml",
    "option",
    "to_dict",
]

LARGEST_INT = 2**31 - 1
"""What native code counts in."""

_LARGEST_TOML_BYTES = 1 << 24

T = TypeVar("T")


def option(
    default: Any,
    text: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    above: float | None = None,
    maximum: float | None = None,
    affects_result: bool = True,
    used_with: tuple[str, tuple[StrEnum, ...]] | None = None,
) -> Any:
    """Declare a field with the metadata that the command line and the resume logic need.

    Parameters
    ----------
    default : object
    text : str
        The help text, a sentence without its full stop.
    unit : str
        Unit shown in the help.
    minimum : float, optional
        Smallest valid value.
    above : float, optional
        Valid values are larger than this.
    maximum : float, optional
        Largest valid value; for whole numbers `LARGEST_INT` if not given. Floats must be finite in any case.
    affects_result : bool
        False for options of speed and memory only: they do not make finished work stale.
    used_with : tuple, optional
        The name of another option of the class, and those of its choices with which this one has an effect.
    """
    return dataclasses.field(
        default=default,
        metadata={
            "help": text,
            "unit": unit,
            "minimum": minimum,
            "above": above,
            "maximum": maximum,
            "affects_result": affects_result,
            "used_with": used_with,
        },
    )


def _convert(annotation: Any, value: Any) -> Any:
    """Value from TOML or JSON as the type a field is annotated with; raises `ValueError` or `TypeError`."""
    origin = typing.get_origin(annotation)
    if origin in (typing.Union, types.UnionType):
        inner = [a for a in typing.get_args(annotation) if a is not type(None)]
        return None if value is None else _convert(inner[0], value)
    if origin is tuple:
        items = [value] if isinstance(value, str) else value
        inner = typing.get_args(annotation)[0]
        # Of choices at least one is made; a list of files may be empty.
        if not items and isinstance(inner, type) and issubclass(inner, StrEnum):
            raise ValueError
        return tuple(_convert(inner, item) for item in items)
    if isinstance(annotation, type) and issubclass(annotation, StrEnum):
        return annotation(value)
    if origin is typing.Literal:
        if value not in typing.get_args(annotation):
            raise ValueError
        return value
    if annotation is Path:
        path = Path(value)
        if why_unusable(os.fspath(value)):
            raise ValueError
        return path
    if annotation is float and type(value) is int:
        return float(value)
    if type(value) is not annotation:
        raise TypeError
    return value


_WORDS = {
    dict: "a table",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    Path: "a path",
    str: "text",
}


def _expected(annotation: Any) -> str:
    if typing.get_origin(annotation) is typing.Literal:
        return "one of " + ", ".join(str(choice) for choice in typing.get_args(annotation))
    choices = [
        a
        for a in (annotation, *typing.get_args(annotation))
        if isinstance(a, type) and issubclass(a, StrEnum)
    ]
    if choices:
        return "one of " + ", ".join(choices[0])
    kinds = (annotation, typing.get_origin(annotation), *typing.get_args(annotation))
    return next(words for kind, words in _WORDS.items() if kind in kinds)


def from_dict(cls: type[T], values: dict[str, Any], where: str) -> T:
    """Build a config from plain values.

    Parameters
    ----------
    cls : type
        A config dataclass; fields that are config dataclasses themselves are nested tables.
    values : dict
    where : str
        What the values come from, for messages.

    Raises
    ------
    ConfigError
        Listing every unknown key and wrong value at once, with the valid keys.
    """
    problems: list[str] = []
    config = _build(cls, values, "", problems)
    if problems:
        raise ConfigError(f"{where}: " + "; ".join(problems))
    return config


def _build(cls: type[T], values: dict[str, Any], prefix: str, problems: list[str]) -> Any:
    annotations = typing.get_type_hints(cls)
    names = [entry.name for entry in dataclasses.fields(cls)]  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        name = key.replace("-", "_")
        if name in arguments:
            problems.append(f"'{prefix}{key}' is there twice, with - and with _")
        elif name not in names:
            problems.append(f"unknown key '{prefix}{key}', valid are {', '.join(names)}")
        elif dataclasses.is_dataclass(annotations[name]):
            if isinstance(value, dict):
                arguments[name] = _build(typing.cast(type, annotations[name]), value, f"{name}.", problems)
            else:
                problems.append(f"'{prefix}{key}' must be a table")
        else:
            try:
                arguments[name] = _convert(annotations[name], value)
            except (TypeError, ValueError):
                problems.append(f"{prefix}{key} is {value!r}, expected {_expected(annotations[name])}")
    config = cls(**arguments)
    for entry in dataclasses.fields(config):  # type: ignore[arg-type]
        expected = _expected_instead(entry, getattr(config, entry.name))
        if expected:
            problems.append(f"{prefix}{entry.name} is {getattr(config, entry.name)}, expected {expected}")
    return config


def _expected_instead(entry: dataclasses.Field, value: Any) -> str:
    """Range of an option that a number falls outside of; empty if it fits or is not a number."""
    if type(value) not in (int, float):
        return ""
    minimum, above, maximum = (entry.metadata.get(key) for key in ("minimum", "above", "maximum"))
    if maximum is None and type(value) is int:
        maximum = LARGEST_INT
    if type(value) is float and not math.isfinite(value):
        return "a finite number"
    if minimum is not None and value < minimum:
        return f"at least {minimum}"
    if above is not None and value <= above:
        return f"more than {above}"
    return f"at most {maximum}" if maximum is not None and value > maximum else ""


def to_dict(config: Any, *, only_result: bool = False) -> dict[str, Any]:
    """Plain values of a config, ready for JSON; with ``only_result`` without options of speed and memory."""
    values: dict[str, Any] = {}
    for entry in dataclasses.fields(config):
        if only_result and not entry.metadata.get("affects_result", True):
            continue
        value = getattr(config, entry.name)
        if dataclasses.is_dataclass(value):
            value = to_dict(value, only_result=only_result)
        elif isinstance(value, Path):
            value = value.as_posix()
        elif isinstance(value, tuple):
            value = [str(item) for item in value]
        values[entry.name] = value
    return values


def absolute(config: T) -> T:
    """A config whose files and folders are named by absolute paths, for a process in another folder."""
    paths = {
        entry.name: value.absolute()
        for entry in dataclasses.fields(config)  # type: ignore[arg-type]
        # What is not there may be the name of something that comes with the package, as of a network, which
        # is never a folder.
        if isinstance(value := getattr(config, entry.name), Path)
        and (value.is_file() or (value.is_dir() and entry.name != "model"))
    }
    return dataclasses.replace(config, **paths)  # type: ignore[type-var]


def config_hash(*parts: Any) -> str:
    """Hex digest of configs, strings, numbers and nested lists of them; equal values give equal digests.

    Options that do not affect results are left out.
    """
    return hash_encoded(*map(encoded, parts))


def hash_of_content(path: Path) -> str:
    """Hex digest of what a file, or all files of a folder, hold; what reads them reports missing ones."""
    if os.path.isdir(path):
        return config_hash(
            *[[file.name, sha256_of(file)] for file in sorted(path.iterdir()) if file.is_file()]
        )
    return config_hash(sha256_of(path) if os.path.isfile(path) else "")


def encoded(part: Any) -> str:
    """A part of `config_hash` as text, for `hash_encoded`; where millions of hashes share it, made once."""
    if type(part) is str:
        return encode_basestring_ascii(part)
    plain = to_dict(part, only_result=True) if dataclasses.is_dataclass(part) else part
    return json.dumps(plain, sort_keys=True, default=str)


def hash_encoded(*texts: str) -> str:
    """`config_hash` of parts that `encoded` made texts of."""
    return hashlib.sha256(f"[{', '.join(texts)}]".encode()).hexdigest()


def flag_of(name: str) -> str:
    """The flag of a field on the command line."""
    return "--" + name.replace("_", "-")


def flags_of(options: type, values: dict[str, Any]) -> list[str]:
    """The flags that give a config its recorded values, where they differ from the defaults."""
    words: list[str] = []
    for name, default in to_dict(options()).items():
        value = values.get(name, default)
        if value == default or value is None:
            continue
        flag = flag_of(name)
        if isinstance(value, bool):
            words.append(flag if value else f"--no-{flag[2:]}")
        else:
            for item in value if isinstance(value, list) else [value]:
                words += [flag, str(item)]
    return words


def load_toml(path: Path, what: str) -> dict[str, Any]:
    """The tables of a TOML file.

    Parameters
    ----------
    path : Path
    what : str
        What the file should be, with its article, for messages.

    Raises
    ------
    ConfigError
        If the file is missing, cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(read_text(path, largest_bytes=_LARGEST_TOML_BYTES))
    except InputError as error:
        raise ConfigError(f"{error}; expected {what} in TOML") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"{path}: its values are nested too deep; expected {what}") from error
    except ValueError as error:  # a number of thousands of digits
        raise ConfigError(f"{path}: holds a value that cannot be read ({error}); expected {what}") from error
