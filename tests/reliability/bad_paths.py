"""Every path that a command takes, each with every kind of thing that it does not expect there."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import click
from case import EITHER, REFUSED, Case, Trial
from place import Place

from corrsfm.cli import main

__all__ = ["cases", "commands"]

QUICK = ["--max-features", "200", "--threads", "1"]
RUN = ["--threads", "1"]


def commands() -> Iterator[tuple[str, click.Command]]:
    """Every command with its words, such as ``evaluate pose``."""

    def walk(command: click.Command, words: list[str]) -> Iterator[tuple[str, click.Command]]:
        if isinstance(command, click.Group):
            for name, inner in command.commands.items():
                yield from walk(inner, [*words, name])
        else:
            yield " ".join(words), command

    yield from walk(main, [])


def good_call(command: str, place: Place) -> tuple[dict[str, list[str]], list[str], list[str]]:
    """A call that works: arguments by parameter, in order, further words, and what it writes."""
    match command:
        case "run" | "extract":
            return {"photos": [str(place.photos())], "workspace_dir": ["out"]}, QUICK, ["out"]
        case "import":
            photos = {"images_dir": [str(place.photos())], "workspace_dir": ["out"]}
            return photos, ["--features", str(place.base / "hloc_features.h5")], ["out"]
        case "pairs" | "match" | "prune" | "reconstruct":
            return {"workspace_dir": [str(place.scene())]}, RUN, ["scene"]
        case "report":
            return {"workspace_dir": [str(place.scene())]}, [], ["scene"]
        case "add":
            new = place.file("new.jpg", (place.base / "photos" / "2.jpg").read_bytes() + b"\0")
            return {"workspace_dir": [str(place.scene())], "photos": [str(new)]}, RUN, ["scene", "photos"]
        case "localize":
            new = place.file("new.jpg", (place.base / "photos" / "2.jpg").read_bytes())
            return {"workspace_dir": [str(place.scene())], "photos": [str(new)]}, RUN, ["out"]
        case "export":
            scene = str(place.scene())
            return {"workspace_dir": [scene], "output": ["out"]}, ["--for", "colmap"], ["out"]
        case "check":
            return {"photos": [str(place.photos())]}, ["--no-forecast", *RUN], ["out"]
        case "batch":
            (place.work / "scenes").mkdir()
            place.photos(name="scenes/a")
            return {"collection": ["scenes"], "output": ["out"]}, QUICK, ["out"]
        case "compare":
            more = ["--methods", "corradaptor", "--seeds", "1", *QUICK]
            return {"images_dir": [str(place.photos())]}, more, ["out", "compare_photos"]
        case "evaluate pose":
            return (
                {"pairs_file": [str(place.base / "pairs.h5")]},
                ["--method", "mutual/poselib", *RUN],
                ["out"],
            )
        case "evaluate homography":
            (place.work / "planes" / "v_wall").mkdir(parents=True)
            for number in range(1, 7):
                (place.work / "planes" / "v_wall" / f"{number}.ppm").write_bytes(
                    (place.base / "wall.ppm").read_bytes()
                )
                place.file(f"planes/v_wall/H_1_{number}", "1 0 0\n0 1 0\n0 0 1\n")
            return {"folder": ["planes"]}, RUN, ["out"]
        case "evaluate scene":
            more = ["--ground-truth", str(place.model()), "--seeds", "1", *RUN]
            return {"workspace_dir": [str(place.scene())]}, more, ["scene"]
        case "bench":
            more = ["--num-matches", "64", *RUN]
            return {}, more, ["out"]
        case "train prepare":
            (place.work / "yard").mkdir()
            place.photos(5, "yard/images")
            place.model("yard/model")
            return {"scenes": ["yard"]}, ["--output", "out", "--max-features", "200"], ["out"]
        case "train run":
            more = ["--train-files", str(place.base / "pairs.h5"), "--max-steps", "1", "--batch-size", "1"]
            return {}, [*more, "--num-matches", "64", "--output", "out", "--threads", "1"], ["out"]
        case "train export":
            place.file("net.pt", (place.base / "net.pt").read_bytes())
            return {"source": ["net.pt"], "output": ["out"]}, [], ["out"]
        case "train plots":
            return {}, ["--pairs", str(place.base / "pairs.h5"), "--output", "out"], ["out"]
    raise KeyError(command)


def _missing(path: Path) -> None:
    pass


def _fifo(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        # Names of sockets have at most 107 bytes.
        here = os.getcwd()
        os.chdir(path.parent)
        made.bind(path.name)
        os.chdir(here)


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _folder(path: Path) -> None:
    path.mkdir()


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _noise(path: Path) -> None:
    path.write_bytes(bytes((i * i * 31 + i // 7) % 256 for i in range(5000)))


def _text(path: Path) -> None:
    path.write_text("this is not what you look for\n" * 20)


def _dangling(path: Path) -> None:
    path.symlink_to(path.with_name("nowhere"))


def _looping(path: Path) -> None:
    path.symlink_to(path)


def _closed(path: Path) -> None:
    path.write_bytes(b"secret")
    path.chmod(0)


def _closed_folder(path: Path) -> None:
    path.mkdir()
    (path / "a.jpg").write_bytes(b"secret")
    path.chmod(0)


KINDS: dict[str, Callable[[Path], None]] = {
    "missing": _missing,
    "fifo": _fifo,
    "socket": _socket,
    "device": _device,
    "folder": _folder,
    "empty": _empty,
    "noise": _noise,
    "text": _text,
    "dangling": _dangling,
    "looping": _looping,
    "closed": _closed,
    "closed-folder": _closed_folder,
}
"""What may be at a path."""

NAMES: dict[str, str] = {
    "long": "n" * 300,
    "below-a-file": "plain/inside",
    "empty-name": "",
    "surrogate": "bad\udcff\udc80",
    "line-break": "bad\nname",
    "escape": "bad\x1b[2Jname",
    "dash": "-bad",
    "control": "bad\x01name",
    "deep": "/".join(["deep"] * 1000),
}
"""Paths at which there can be nothing, or whose names are hard to write."""

# Suffixes that decide how a file is read.
SUFFIXES = {
    "photos": ".jpg", "file": ".toml", "model": ".pt", "image_list": ".txt", "splits": ".json",
    "features": ".h5", "matches": ".h5", "database": ".db", "source": ".pt", "pairs_file": ".txt",
    "results": ".json", "superpoint_weights": ".pth",
}  # fmt: skip

# Parameters where these things are not wrong: a folder that is made, a file that is replaced.
OUTPUTS = {
    "output", "csv_file", "keep", "results",
    *("workspace_dir",),
}  # fmt: skip
MINE = (
    "images.txt", "images.json", "cameras.json", "pairs.txt", "log.txt", "report.html", "database.db", "sparse/0/a",
    ".photos.json", "evidence.json", "features.db/a", "run.json",
)  # fmt: skip
"""What a user may have in a folder, of the names that a workspace has."""
NEEDED_WITH = {"superpoint_weights": ["--extractor", "superpoint"]}


def _takes_workspace(command: str) -> bool:
    """Whether a command makes its workspace rather than reads it."""
    return command in ("run", "extract", "import")


def cases() -> Iterator[Case]:
    """Every path parameter of every command × what it may be."""
    for words, command in commands():
        for parameter in command.params:
            if isinstance(parameter.type, click.Path):
                for kind in (*KINDS, *NAMES):
                    yield Case(
                        name=f"path {words} {parameter.name} {kind}",
                        prepare=lambda place, w=words, p=parameter, k=kind: _trial(place, w, p, k),
                    )
    for words in ("run", "extract", "import"):
        for name in MINE:
            yield Case(
                name=f"path {words} over {name} of the user",
                prepare=lambda place, w=words, n=name: _over(place, w, n),
            )


def _over(place: Place, words: str, name: str) -> Trial:
    """The folder of the workspace holds a file that the workspace would replace."""
    arguments, more, _ = good_call(words, place)
    place.file(f"out/{name}", "mine")
    given = [word for values in arguments.values() for word in values]
    return Trial(arguments=[words, *given, *more], named=[name.split("/")[0]], writes=[])


def _trial(place: Place, words: str, parameter: click.Parameter, kind: str) -> Trial:
    arguments, more, writes = good_call(words, place)
    name = str(parameter.name)
    if kind in KINDS:
        bad = f"bad{SUFFIXES.get(name, '')}"
        KINDS[kind](place.work / bad)
    else:
        place.file("plain", "x")
        bad = NAMES[kind]
    is_output = name in ("output", "csv_file", "keep", "results") or (
        name == "workspace_dir" and _takes_workspace(words)
    )
    rest: list[str] = []
    if isinstance(parameter, click.Argument):
        arguments[name] = [bad]
    else:
        flag = max(parameter.opts, key=len)
        if flag in more:
            place_of = more.index(flag)
            more = more[:place_of] + more[place_of + 2 :]
        rest = [f"{flag}={bad}" if bad else flag, *([] if bad else [""])]
        rest += NEEDED_WITH.get(name, [])
        if name == "run_folder":
            more = [word for word in more if word not in ("--pairs", str(place.base / "pairs.h5"))]
        if (name, words) == ("database", "import"):
            more = []
        if name == "ground_truth" and words == "compare":
            more = [*more]
    values = [value for values in arguments.values() for value in values]
    dashed = [value for value in values if value.startswith("-")]
    words_of = [*words.split(), *more, *rest, *(["--"] if dashed else []), *values]
    if words == "batch":
        words_of = [*words.split(), *(["--"] if dashed else []), *values, *([] if dashed else more)]
    named = [shown for shown in (bad, Path(bad).name, ascii(bad)[1:-1], bad[:60]) if shown] or ["empty"]
    if (words, name) == ("import", "mask_dir"):
        named.append("--mask-dir")
    return Trial(
        arguments=words_of,
        named=named,
        writes=[
            *writes,
            *([bad.removeprefix("/")] if is_output and bad else []),
            *(["bad"] if is_output else []),
        ],
        # An empty pipeline file is one, with nothing in it.
        expected=EITHER
        if is_output or kind in ("folder", "dash") or (name, kind) == ("file", "empty")
        else REFUSED,
        begins=words
        in ("run", "compare", "batch", "add", "pairs", "prune", "match", "reconstruct", "extract"),
        as_nobody=kind.startswith("closed"),
    )
