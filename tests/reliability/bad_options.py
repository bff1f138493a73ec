"""Every number that a command takes at its extremes, texts that are none, and pipeline files of every kind."""

from __future__ import annotations

from collections.abc import Iterator

import click
from bad_paths import commands, good_call
from case import EITHER, REFUSED, Case, Trial
from place import NUM_PHOTOS, Place

__all__ = ["cases"]

WHOLE = ("-1", "0", "1", "2147483647", "2147483648", "9223372036854775808", "1" + "0" * 400, "1.5", "x")
REAL = ("-1", "0", "1e-300", "1e300", "nan", "inf", "-inf", "1" + "0" * 400, "x")
# Options that cost what they say: 2^31 threads, steps or seeds are what was asked for.
SLOW = {"threads", "max_steps", "batch_size", "sizes", "batch_sizes", "num_seeds", "num_matches"}


def cases() -> Iterator[Case]:
    """All of them."""
    for words, command in commands():
        if words in ("compare", "bench", "batch"):
            continue
        for parameter in command.params:
            values = {click.types.IntParamType: WHOLE, click.types.FloatParamType: REAL}.get(
                type(parameter.type)
            )
            if isinstance(parameter.type, click.IntRange):
                values = WHOLE
            for value in values or ():
                if parameter.name in SLOW and value in ("2147483647", "2147483648"):
                    continue
                label = value if len(value) < 30 else "400-digits"
                yield Case(
                    name=f"number {words} {parameter.name} {label}",
                    prepare=lambda place, w=words, p=parameter, v=value: _number(place, w, p, v),
                )
    for label, text in _tables().items():
        yield Case(name=f"toml run {label}", prepare=lambda place, t=text: _toml(place, t, training=False))
        yield Case(name=f"toml train {label}", prepare=lambda place, t=text: _toml(place, t, training=True))
    for label, words in OUTPUTS.items():
        for victim in VICTIMS:
            yield Case(
                name=f"output {label} over {victim}",
                prepare=lambda place, w=words, v=victim: _output(place, w, v),
            )
    for label, words in _cameras().items():
        yield Case(name=f"camera {label}", prepare=lambda place, w=words: _camera(place, w))
    for label, words in _scales().items():
        yield Case(name=f"export {label}", prepare=lambda place, w=words: _export(place, w))


OUTPUTS = {
    "keep": ["check", "photos", "--no-forecast", "--keep"],
    "csv": ["localize", "scene", "photos/1.jpg", "--threads", "1", "--csv"],
    "export csv": ["export", "scene", "--for", "csv"],
    "export ply": ["export", "scene", "--for", "ply"],
    "pairs": ["train", "prepare", "photos", "--output"],
    "checkpoint": ["train", "export", "net.pt"],
    "plots": ["train", "plots", "--pairs", "pairs.h5", "--output"],
    "bench": ["bench", "--num-matches", "32", "--results"],
    "compare": ["compare", "photos", "--methods", "ratio", "--results"],
    "evaluate": ["evaluate", "pose", "pairs.h5", "--method", "mutual/poselib", "--results"],
}
"""Commands that write a file, whose name comes last."""
VICTIMS = (
    "photos/0.jpg",
    "scene/features.db",
    "scene/database.db",
    "scene/images.json",
    "scene/sparse/0/images.bin",
)


def _output(place: Place, words: list[str], victim: str) -> Trial:
    """A file of another kind has the name of what is to be written."""
    place.scene()
    for name in ("net.pt", "pairs.h5"):
        place.file(name, (place.base / name).read_bytes())
    return Trial(arguments=[*words, victim], named=[victim.split("/")[-1], "sparse"], writes=["scene/.lock"])


def _number(place: Place, words: str, parameter: click.Parameter, value: str) -> Trial:
    arguments, more, writes = good_call(words, place)
    flag = max(parameter.opts, key=len)
    if flag in more:
        position = more.index(flag)
        more = more[:position] + more[position + 2 :]
    values = [word for words_of in arguments.values() for word in words_of]
    return Trial(
        arguments=[*words.split(), *more, f"{flag}={value}", *values],
        named=[flag, str(parameter.name), value[:20], "out", "scene", "photos", "planes", "pairs.h5"],
        writes=writes,
        expected=EITHER,
        begins=True,
    )


def _tables() -> dict[str, bytes | str]:
    """Label → a file of options that is none."""
    deep = 3000
    return {
        "unknown table": "[nothing]\na = 1\n",
        "unknown key": "[features]\nmax_feature = 1\n",
        "wrong type": '[features]\nmax_features = "many"\n',
        "wrong bool": "[features]\nroot_sift = 1\n",
        "float for int": "[features]\nmax_features = 10.5\n",
        "list for int": "[features]\nmax_features = [1]\n",
        "table for int": "[features.max_features]\na = 1\n",
        "int for table": "features = 3\n",
        "list for table": "features = [1, 2]\n",
        "tables in list": "[[features]]\nmax_features = 3\n",
        "negative": "[features]\nmax_features = -5\n",
        "huge int": "[features]\nmax_features = 99999999999999999999\n",
        "thousands of digits": "[features]\nmax_features = " + "9" * 10000 + "\n",
        "nan": "[pairs]\nmax_distance_m = nan\n",
        "inf": "[pairs]\nmax_distance_m = inf\n",
        "date": "[pairs]\nmax_distance_m = 1979-05-27\n",
        "choice": '[prune]\nmethod = "magic"\n',
        "list of choices": '[pairs]\npairing = ["auto", 3]\n',
        "empty list": "[pairs]\npairing = []\n",
        "number for path": "[pairs]\npairs_file = 3\n",
        "nul in path": '[pairs]\npairs_file = "a\\u0000b"\npairing = ["file"]\n',
        "long path": f'[pairs]\npairs_file = "{"n" * 5000}"\npairing = ["file"]\n',
        "nul in text": '[images]\ncamera_model = "A\\u0000B"\n',
        "escape in text": '[images]\ncamera_model = "\\u001b[2J"\n',
        "twice": "[features]\nmax_features = 3\nmax_features = 4\n",
        "deep list": "a = " + "[" * deep + "]" * deep + "\n",
        "deep table": "[" + ".".join(["a"] * deep) + "]\n",
        "deep inline": "a = " + "{a = " * deep + "1" + "}" * deep + "\n",
        "deep value": "[features]\nmax_features = " + "[" * 200 + "]" * 200 + "\n",
        "huge": "# " + "x" * 30_000_000 + "\n",
        "many keys": "".join(f"k{number} = 1\n" for number in range(20000)),
        "long key": f"{'k' * 100000} = 1\n",
        "long text": f'[images]\ncamera_model = "{"x" * 100000}"\n',
        "key with break": '"a\\nb" = 1\n',
        "key with escape": '"a\\u001b[2J" = 1\n',
        "open": "[features\n",
        "json": '{"features": {"max_features": 3}}',
        "utf-16": "[features]\n".encode("utf-16"),
        "latin": b"# caf\xe9\n",
        "nul": b"\0\0\0\0",
        "control": b"a = \x01\n",
    }


def _toml(place: Place, text: bytes | str, *, training: bool) -> Trial:
    path = place.file("bad.toml", text)
    if training:
        pairs = str(place.base / "pairs.h5")
        arguments = ["train", "run", "--config", str(path), "--train-files", pairs, "--output", "out"]
    else:
        photos = place.photos(3)
        arguments = ["run", str(photos), "out", "--pipeline", str(path), "--threads", "1"]
    return Trial(
        arguments=arguments,
        named=["bad.toml", "pairs_file", "nnnn", "a\\x00b", "camera_model"],
        writes=["out"],
    )


def _cameras() -> dict[str, list[str]]:
    """Label → options of cameras that are none."""
    pinhole = ["--camera-model", "SIMPLE_PINHOLE", "--camera-params"]
    return {
        "unknown": ["--camera-model", "MAGIC"],
        "empty": ["--camera-model", ""],
        "long": ["--camera-model", "X" * 10000],
        "lower": ["--camera-model", "simple_pinhole"],
        "break": ["--camera-model", "A\nB"],
        "too few": [*pinhole, "130,80"],
        "too many": [*pinhole, "130,80,60,1"],
        "thousands": [*pinhole, ",".join(["1"] * 20000)],
        "letters": [*pinhole, "a,b,c"],
        "commas": [*pinhole, ",,"],
        "nan": [*pinhole, "nan,80,60"],
        "inf": [*pinhole, "inf,80,60"],
        "zero": [*pinhole, "0,80,60"],
        "negative": [*pinhole, "-130,80,60"],
        "tiny": [*pinhole, "1e-300,80,60"],
        "huge": [*pinhole, "1e300,80,60"],
        "centre huge": [*pinhole, "130,1e300,60"],
        "underscore": [*pinhole, "1_30,80,60"],
        "hex": [*pinhole, "0x10,80,60"],
        "two videos": ["--frames", "3", "--every", "1s"],
        "every": ["--every", "soon"],
        "every nan": ["--every", "nans"],
        "device": ["--device", "cuda:99"],
        "device text": ["--device", "toaster"],
        "device break": ["--device", "cpu\n"],
    }


def _camera(place: Place, words: list[str]) -> Trial:
    photos = place.photos(NUM_PHOTOS)
    arguments = ["run", str(photos), "out", "--max-features", "200", "--threads", "1", *words]
    named = [
        words[0],
        words[0].strip("-").replace("-", "_"),
        "camera_params",
        "camera_model",
        "every",
        "out",
        "camera of model",
    ]
    return Trial(arguments=arguments, named=named, writes=["out"], expected=EITHER, begins=True)


def _scales() -> dict[str, list[str]]:
    return {
        "same photo": ["--scale", "0.jpg", "0.jpg", "1"],
        "unknown photo": ["--scale", "0.jpg", "nowhere.jpg", "1"],
        "zero": ["--scale", "0.jpg", "1.jpg", "0"],
        "negative": ["--scale", "0.jpg", "1.jpg", "-1"],
        "nan": ["--scale", "0.jpg", "1.jpg", "nan"],
        "inf": ["--scale", "0.jpg", "1.jpg", "inf"],
        "tiny": ["--scale", "0.jpg", "1.jpg", "1e-320"],
        "huge": ["--scale", "0.jpg", "1.jpg", "1e308"],
        "no gps": ["--scale", "gps"],
        "two words": ["--scale", "gps", "gps"],
        "photos elsewhere": ["--images", "."],
    }


def _export(place: Place, words: list[str]) -> Trial:
    scene = place.scene()
    named = ["--scale", "0.jpg", "nowhere.jpg", "scene", "GPS", "gps", "photos"]
    expected = EITHER if "1e308" in words or "1e-320" in words else REFUSED
    return Trial(
        arguments=["export", str(scene), "out", "--for", "csv", *words],
        named=named,
        writes=["out"],
        expected=expected,
    )
