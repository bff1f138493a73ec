"""Broken lists, checkpoints, and files of other tools."""

from __future__ import annotations

import io
import os
import pickle
import sqlite3
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import h5py
import numpy as np
from case import EITHER, REFUSED, Case, Trial
from place import Place

__all__ = ["cases"]

# What a later run would stumble over, if it were let in.
_NEVER_USABLE = (
    "scale", "orientation", "link to pipe", "name bytes", "matches itself", "view", "pair", "nothing wide",
    "matches nothing wide", "rows blob",
)  # fmt: skip
QUICK = ["--max-features", "200", "--threads", "1"]


def cases() -> Iterator[Case]:
    """All of them."""
    for label, text in _lists().items():
        yield Case(name=f"list image {label}", prepare=lambda place, t=text: _list(place, t, "--image-list"))
        yield Case(name=f"list pairs {label}", prepare=lambda place, t=text: _list(place, t, "--pairs-file"))
        yield Case(name=f"list given {label}", prepare=lambda place, t=text: _list(place, t, ""))
    for label, pattern in _patterns().items():
        yield Case(name=f"pattern {label}", prepare=lambda place, p=pattern: _pattern(place, p))
    for label, make in _checkpoints().items():
        yield Case(name=f"checkpoint prune {label}", prepare=lambda place, m=make: _prune(place, m))
        yield Case(name=f"checkpoint export {label}", prepare=lambda place, m=make: _net_export(place, m))
    for label, spoil in _hdf5().items():
        expected = _expected(label)
        yield Case(
            name=f"hloc features {label}",
            prepare=lambda place, s=spoil, e=expected: _hloc(place, s, "features", e),
        )
    for label, spoil in _hdf5_matches().items():
        yield Case(name=f"hloc matches {label}", prepare=lambda place, s=spoil: _hloc(place, s, "matches"))
    for label, statements in _databases().items():
        expected = _expected(label)
        yield Case(
            name=f"database {label}",
            prepare=lambda place, s=statements, e=expected: _database(place, s, e),
        )
    for label, spoil in _pairs().items():
        for command in ("evaluate pose", "train run", "train plots"):
            yield Case(
                name=f"pairs {command} {label}",
                prepare=lambda place, s=spoil, c=command: _labelled(place, s, c),
            )
    for label, text in _splits().items():
        yield Case(name=f"splits {label}", prepare=lambda place, t=text: _split(place, t))
        yield Case(name=f"results {label}", prepare=lambda place, t=text: _results(place, t))


# lists --------------------------------------------------------------------------------------------------------


def _lists() -> dict[str, bytes]:
    return {
        "empty": b"", "comments": b"# nothing\n# here\n", "blank": b"\n \n\t\n", "nul": b"0.jpg\0\n1.jpg\n",
        "utf-16": "0.jpg 1.jpg\n".encode("utf-16"), "latin": b"caf\xe9.jpg 0.jpg\n", "escape": b"\x1b[2J.jpg 0.jpg\n",
        "absolute": b"/etc/passwd 0.jpg\n/etc/hosts\n", "above": b"../../etc/passwd 0.jpg\n",
        "missing": b"nowhere.jpg 0.jpg\n", "folder": b". 0.jpg\n.\n", "long name": b"n" * 5000 + b" 0.jpg\n",
        "long line": b"n" * 20_000_000 + b"\n", "many lines": b"nowhere.jpg 0.jpg\n" * 300_000,
        "one column": b"0.jpg\n", "three columns": b"0.jpg 1.jpg 2.jpg\n", "itself": b"0.jpg 0.jpg\n",
        "binary": np.random.default_rng(0).bytes(5000), "json": b'["0.jpg", "1.jpg"]\n', "quotes": b"\"0.jpg 1.jpg\n'\n",
        "large": b"#" + bytes(1000) * 300_000,
    }  # fmt: skip


def _list(place: Place, text: bytes, flag: str) -> Trial:
    photos = place.photos()
    path = place.file("bad.txt", text)
    if not flag:
        arguments = ["extract", str(path), "out", *QUICK]
    elif flag == "--pairs-file":
        arguments = ["extract", str(photos), "out", "--pairing", "file", flag, str(path), *QUICK]
    else:
        arguments = ["extract", str(photos), "out", flag, str(path), *QUICK]
    return Trial(
        arguments=arguments, named=["bad.txt", "nowhere.jpg"], writes=["out"], begins=flag == "--pairs-file"
    )


def _patterns() -> dict[str, str]:
    return {
        "nothing": "photos/*.gif", "open": "photos/[a", "open not": "photos/[!", "only star": "*", "stars": "**/**/**/**/*",
        "question": "photos/?", "brace": "photos/{0,1}.jpg", "many stars": "*" * 200, "home": "~/*.jpg", "root": "/dev/*",
        "long": "photos/" + "[0-9]" * 100,
    }  # fmt: skip


def _pattern(place: Place, pattern: str) -> Trial:
    place.photos()
    os.mkfifo(place.work / "pipe.jpg")
    return Trial(
        arguments=["extract", pattern, "out", *QUICK],
        named=[pattern, pattern[:60], "pipe.jpg"],
        writes=["out"],
        expected=EITHER,
    )


# checkpoints --------------------------------------------------------------------------------------------------


class _Evil:
    def __reduce__(self) -> tuple[Any, ...]:
        return (os.system, ("touch hacked",))


def _saved(content: Any, **options: Any) -> bytes:
    import torch

    stream = io.BytesIO()
    torch.save(content, stream, **options)
    return stream.getvalue()


def _good(place: Place) -> dict[str, Any]:
    import torch

    return dict(torch.load(place.base / "net.pt", weights_only=True))


def _checkpoints() -> dict[str, Callable[[Place], bytes]]:
    import torch

    def with_tensor(change: Callable[[Any], Any]) -> Callable[[Place], bytes]:
        def make(place: Place) -> bytes:
            content = _good(place)
            state = dict(content["state_dict"])
            name = next(key for key in sorted(state) if key.endswith("weight") and state[key].ndim > 1)
            state[name] = change(state[name].float())
            return _saved({**content, "state_dict": state})

        return make

    def with_value(key: str, value: Any) -> Callable[[Place], bytes]:
        return lambda place: _saved({**_good(place), key: value})

    def with_config(**values: Any) -> Callable[[Place], bytes]:
        return lambda place: _saved({**(good := _good(place)), "config": {**good["config"], **values}})

    def cut(share: float) -> Callable[[Place], bytes]:
        def make(place: Place) -> bytes:
            content = (place.base / "net.pt").read_bytes()
            return content[: int(share * len(content))]

        return make

    def flipped(place: Place) -> bytes:
        content = bytearray((place.base / "net.pt").read_bytes())
        for number in np.random.default_rng(0).integers(0, len(content), 50):
            content[number] ^= 255
        return bytes(content)

    def zipped(entries: dict[str, bytes]) -> Callable[[Place], bytes]:
        def make(_: Place) -> bytes:
            stream = io.BytesIO()
            with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
                for name, content in entries.items():
                    file.writestr(name, content)
            return stream.getvalue()

        return make

    deep: Any = []
    for _ in range(100):
        deep = [deep]
    huge = 2**31 - 1
    return {
        "code": lambda _: _saved({"state_dict": _Evil()}),
        "code old": lambda _: _saved({"state_dict": _Evil()}, _use_new_zipfile_serialization=False),
        "code pickle": lambda _: pickle.dumps(_Evil()),
        "code in provenance": with_value("provenance", _Evil()),
        "list": lambda _: _saved([1, 2]), "number": lambda _: _saved(3), "text": lambda _: _saved("x"),
        "tensor": lambda _: _saved(torch.zeros(3)), "empty dict": lambda _: _saved({}),
        "deep": lambda _: _saved({"state_dict": deep}), "state list": with_value("state_dict", [1]),
        "state none": with_value("state_dict", None), "state empty": with_value("state_dict", {}),
        "state numbers": lambda _: _saved({"state_dict": {1: 2}}), "format": with_value("format", "corrsfm-network-9"),
        "format number": with_value("format", 3), "config none": with_value("config", None),
        "config list": with_value("config", [1]), "config unknown": with_config(magic=1),
        "config key number": lambda place: _saved({**_good(place), "config": {1: 2}}),
        **{f"config {name} {value}": with_config(**{name: value})
           for name in ("channels", "clusters", "heads", "mlp_ratio", "motion_stacking", "oa_filters", "side_channels")
           for value in (-1, 0, huge, 1.5, "x", None)},
        **{f"config neighbours {label}": with_config(neighbors=value)
           for label, value in (("none", []), ("zero", [0, 0]), ("huge", [huge, huge]), ("text", ["a"]), ("number", 3))},
        "usage list": with_value("usage", [1]), "usage unknown": with_value("usage", {"magic": 1}),
        "usage nan": with_value("usage", {"pose_min_score": float("nan")}), "usage text": with_value("usage", {"input": "x"}),
        "provenance text": with_value("provenance", "somewhere"), "provenance list": with_value("provenance", [1]),
        "sparse": with_tensor(lambda value: value.to_sparse()), "complex": with_tensor(lambda value: value.to(torch.complex64)),
        "nan": with_tensor(lambda value: value * float("nan")), "inf": with_tensor(lambda value: value + float("inf")),
        "whole": with_tensor(lambda value: value.to(torch.int64)), "bool": with_tensor(lambda value: value > 0),
        "shape": with_tensor(lambda value: value[..., :-1]), "scalar": with_tensor(lambda value: value.sum()),
        "expanded": with_tensor(lambda _: torch.zeros(1).expand(2**40)),
        "expanded right shape": with_tensor(lambda value: torch.zeros(1).expand(value.shape)),
        "meta": with_tensor(lambda value: value.to("meta")), "parameter": with_tensor(torch.nn.Parameter),
        "number for tensor": with_tensor(lambda _: 3), "list for tensor": with_tensor(lambda value: value.tolist()),
        "double": with_tensor(lambda value: value.double()), "array": with_tensor(lambda value: value.numpy()),
        "quantised": with_tensor(lambda value: torch.quantize_per_tensor(value, 0.1, 0, torch.qint8)),
        "cut half": cut(0.5), "cut end": cut(0.99), "cut begin": cut(0.01), "flipped": flipped,
        "zip other": zipped({"a": b"b"}), "zip bomb": zipped({"archive/data.pkl": bytes(300_000_000), "archive/version": b"3"}),
        "zip path": zipped({"../../hacked": b"x", "archive/data.pkl": b"x"}),
        "safetensors": lambda _: (8).to_bytes(8, "little") + b'{"a":{}}' + bytes(100),
    }  # fmt: skip


def _prune(place: Place, make: Callable[[Place], bytes]) -> Trial:
    path = place.file("bad.pt", make(place))
    arguments = ["prune", str(place.scene()), "--model", str(path), "--threads", "1"]
    return Trial(arguments=arguments, named=["bad.pt"], writes=["scene"], expected=EITHER, begins=True)


def _net_export(place: Place, make: Callable[[Place], bytes]) -> Trial:
    path = place.file("bad.pt", make(place))
    return Trial(
        arguments=["train", "export", str(path), "out"], named=["bad.pt"], writes=["out"], expected=EITHER
    )


# HDF5 ---------------------------------------------------------------------------------------------------------


def _replace(group: h5py.Group, name: str, value: Any, **options: Any) -> None:
    if name in group:
        del group[name]
    if value is not None:
        group.create_dataset(name, data=value, **options)


def _declared(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: str) -> None:
    """A dataset of any size of which nothing is stored."""
    if name in group:
        del group[name]
    group.create_dataset(name, shape, dtype, chunks=tuple(min(side, 1000) for side in shape), fillvalue=0)


def _outside(group: h5py.Group, name: str) -> None:
    del group[name]
    group.create_dataset(name, (40, 2), "f4", external=[("/etc/passwd", 0, 320)])


def _virtual(group: h5py.Group, name: str) -> None:
    del group[name]
    layout = h5py.VirtualLayout((40, 2), "f4")
    layout[:] = h5py.VirtualSource("secret.h5", "x", (40, 2))
    group.create_virtual_dataset(name, layout)


def _shapes(group: h5py.Group, scale: float, orientation: float) -> None:
    _replace(group, "scales", np.full(40, scale))
    _replace(group, "oris", np.full(40, orientation))


def _link_to_pipe(group: h5py.Group) -> h5py.ExternalLink:
    """A link into a file that never ends, beside the group's."""
    os.mkfifo(os.path.join(os.path.dirname(group.file.filename), "pipe.h5"))
    return h5py.ExternalLink("pipe.h5", "/x")


def _spoil_keypoints(change: Callable[[h5py.Group], object]) -> Callable[[h5py.File], object]:
    return lambda file: change(file["1.jpg"])


def _hdf5() -> dict[str, Callable[[h5py.File], object]]:
    on = _spoil_keypoints
    keys = "keypoints"
    return {
        "no keypoints": on(lambda group: _replace(group, keys, None)),
        "flat": on(lambda group: _replace(group, keys, np.zeros(80, "f4"))),
        "scalar": on(lambda group: _replace(group, keys, np.float32(3))),
        "three columns": on(lambda group: _replace(group, keys, np.zeros((40, 3), "f4"))),
        "five axes": on(lambda group: _replace(group, keys, np.zeros((2, 2, 2, 2, 5), "f4"))),
        "text": on(lambda group: _replace(group, keys, np.array([b"a"] * 40))),
        "objects": on(lambda group: _replace(group, keys, ["a"] * 40, dtype=h5py.string_dtype())),
        "references": on(lambda group: _replace(group, keys, [group.ref] * 40, dtype=h5py.ref_dtype)),
        "compound": on(lambda group: _replace(group, keys, np.zeros(40, [("x", "f4"), ("y", "f4")]))),
        "complex": on(lambda group: _replace(group, keys, np.zeros((40, 2), "c8"))),
        "bool": on(lambda group: _replace(group, keys, np.zeros((40, 2), bool))),
        "double": on(lambda group: _replace(group, keys, np.full((40, 2), 1e300))),
        "nan": on(lambda group: _replace(group, keys, np.full((40, 2), np.nan, "f4"))),
        "inf": on(lambda group: _replace(group, keys, np.full((40, 2), np.inf, "f4"))),
        "negative": on(lambda group: _replace(group, keys, np.full((40, 2), -1e6, "f4"))),
        "outside": on(lambda group: _replace(group, keys, np.full((40, 2), 1e9, "f4"))),
        "null": on(lambda group: _replace(group, keys, h5py.Empty("f4"))),
        "huge": on(lambda group: _declared(group, keys, (2**36, 2), "f4")),
        "external": on(lambda group: _outside(group, keys)),
        "virtual": on(lambda group: _virtual(group, keys)),
        "link out": on(lambda group: (_replace(group, keys, None), group.__setitem__(keys, h5py.ExternalLink("/etc/passwd", "/x")))),
        "link dangling": on(lambda group: (_replace(group, keys, None), group.__setitem__(keys, h5py.SoftLink("/nowhere")))),
        "link loop": on(lambda group: (_replace(group, keys, None), group.__setitem__(keys, h5py.SoftLink("/1.jpg/keypoints")))),
        "group": on(lambda group: (_replace(group, keys, None), group.create_group(keys))),
        "group loop": on(lambda group: group.__setitem__("again", group)),
        "descriptors flat": on(lambda group: _replace(group, "descriptors", np.zeros(40, "f4"))),
        "descriptors turned": on(lambda group: _replace(group, "descriptors", np.zeros((40, 64), "f4"))),
        "descriptors nan": on(lambda group: _replace(group, "descriptors", np.full((64, 40), np.nan, "f4"))),
        "descriptors zero": on(lambda group: _replace(group, "descriptors", np.zeros((64, 40), "f4"))),
        "descriptors text": on(lambda group: _replace(group, "descriptors", np.full((64, 40), b"a"))),
        "descriptors complex": on(lambda group: _replace(group, "descriptors", np.ones((64, 40), "c8"))),
        "descriptors huge": on(lambda group: _declared(group, "descriptors", (2**30, 40), "f4")),
        "descriptors none": on(lambda group: _replace(group, "descriptors", None)),
        "descriptors narrow": on(lambda group: _replace(group, "descriptors", np.ones((3, 40), "f4"))),
        "scores short": on(lambda group: _replace(group, "scores", np.zeros(3, "f4"))),
        "scores text": on(lambda group: _replace(group, "scores", np.full(40, b"a"))),
        "scores nan": on(lambda group: _replace(group, "scores", np.full(40, np.nan, "f4"))),
        "size": on(lambda group: _replace(group, "image_size", np.array([1, 2]))),
        "size empty": on(lambda group: _replace(group, "image_size", np.zeros(0))),
        "size nan": on(lambda group: _replace(group, "image_size", np.full(2, np.nan))),
        "size text": on(lambda group: _replace(group, "image_size", np.array([b"a", b"b"]))),
        "scales": on(lambda group: (_replace(group, "scales", np.full(40, -1, "f4")), _replace(group, "oris", np.full(40, np.inf, "f4")))),
        **{f"scale {value}": on(lambda group, v=value: _shapes(group, v, 0)) for value in (-1, 0, np.nan, 1e300)},
        "orientation inf": on(lambda group: _shapes(group, 2, np.inf)),
        "link to pipe": on(lambda group: (_replace(group, keys, None), group.__setitem__(keys, _link_to_pipe(group)))),
        "name bytes": lambda file: file.copy("1.jpg", file, b"p\xff\xfe.jpg"),
        "no photo": lambda file: file.__delitem__("1.jpg"),
        "unknown photo": lambda file: file.copy("1.jpg", file, "../../etc/passwd.jpg"),
        "odd names": lambda file: file.copy("1.jpg", file, "a\nb\x1b[2J.jpg"),
        "empty": lambda file: file.clear(),
    }  # fmt: skip


def _hdf5_matches() -> dict[str, Callable[[h5py.File], object]]:
    def on(change: Callable[[h5py.Group], object]) -> Callable[[h5py.File], object]:
        return lambda file: change(file["0.jpg/1.jpg"])

    keys = "matches0"
    return {
        "none": on(lambda group: _replace(group, keys, None)),
        "float": on(lambda group: _replace(group, keys, np.zeros(40, "f4"))),
        "nan": on(lambda group: _replace(group, keys, np.full(40, np.nan, "f4"))),
        "text": on(lambda group: _replace(group, keys, np.full(40, b"a"))),
        "long": on(lambda group: _replace(group, keys, np.zeros(400, "i4"))),
        "high": on(lambda group: _replace(group, keys, np.full(40, 2**31 - 1, "i4"))),
        "negative": on(lambda group: _replace(group, keys, np.full(40, -7, "i4"))),
        "unsigned": on(lambda group: _replace(group, keys, np.full(40, 2**64 - 1, "u8"))),
        "one partner": on(lambda group: _replace(group, keys, np.zeros(40, "i4"))),
        "scalar": on(lambda group: _replace(group, keys, np.int32(3))),
        "null": on(lambda group: _replace(group, keys, h5py.Empty("i4"))),
        "huge": on(lambda group: _declared(group, keys, (2**36,), "i4")),
        "external": on(lambda group: (_replace(group, keys, None), group.create_dataset(keys, (40,), "i4", external=[("/etc/passwd", 0, 160)]))),
        "link out": on(lambda group: (_replace(group, keys, None), group.__setitem__(keys, h5py.ExternalLink("/etc/passwd", "/x")))),
        "scores short": on(lambda group: _replace(group, "matching_scores0", np.zeros(3, "f2"))),
        "scores text": on(lambda group: _replace(group, "matching_scores0", np.full(40, b"a"))),
        "scores nan": on(lambda group: _replace(group, "matching_scores0", np.full(40, np.nan, "f4"))),
        "itself": lambda file: file.copy("0.jpg/1.jpg", file, "0.jpg/0.jpg"),
        "twice": lambda file: file.copy("0.jpg/1.jpg", file, "1.jpg/0.jpg"),
        "unknown photo": lambda file: file.copy("0.jpg/1.jpg", file, "0.jpg/9.jpg"),
        "too deep": lambda file: file.copy("0.jpg/1.jpg", file, "0.jpg/1.jpg/2.jpg"),
        "empty": lambda file: file.clear(),
    }  # fmt: skip


def _expected(label: str) -> str:
    return REFUSED if label.startswith(_NEVER_USABLE) else EITHER


def _hloc(place: Place, spoil: Callable[[h5py.File], object], which: str, expected: str = EITHER) -> Trial:
    photos = place.photos()
    paths = {}
    for name in ("features", "matches"):
        content = (place.base / f"hloc_{name}.h5").read_bytes()
        paths[name] = place.file("bad.h5" if name == which else f"{name}.h5", content)
    with h5py.File(paths[which], "r+") as file:
        spoil(file)
    given = ["--features", str(paths["features"])]
    if which == "matches":
        given += ["--matches", str(paths["matches"])]
    return Trial(
        arguments=["import", str(photos), "out", *given],
        named=["bad.h5"],
        writes=["out"],
        expected=expected,
    )


# SQLite -------------------------------------------------------------------------------------------------------


def _databases() -> dict[str, list[str]]:
    blob = "UPDATE {} SET data = zeroblob({}) WHERE image_id = 2"
    return {
        "no images": ["DROP TABLE images"], "no keypoints": ["DROP TABLE keypoints"],
        "no descriptors": ["DROP TABLE descriptors"], "no matches": ["DROP TABLE matches"],
        "no column": ["ALTER TABLE images RENAME COLUMN name TO title"],
        "names null": ["UPDATE images SET name = NULL"], "names numbers": ["UPDATE images SET name = image_id"],
        "names blob": ["UPDATE images SET name = x'ff00'"], "name bytes": ["UPDATE images SET name = CAST(x'ff2e6a7067' AS TEXT)"],
        "names same": ["UPDATE images SET name = '0.jpg'"], "ids text": ["CREATE TABLE i AS SELECT 'a' || image_id image_id, name, camera_id FROM images", "DROP TABLE images", "ALTER TABLE i RENAME TO images"],
        "rows negative": ["UPDATE keypoints SET rows = -1"], "rows huge": ["UPDATE keypoints SET rows = 9223372036854775807"],
        "rows text": ["UPDATE keypoints SET rows = 'many'"], "rows null": ["UPDATE keypoints SET rows = NULL"],
        "columns zero": ["UPDATE keypoints SET cols = 0"], "columns three": ["UPDATE keypoints SET cols = 3"],
        "columns huge": ["UPDATE keypoints SET cols = 2147483648"], "data null": ["UPDATE keypoints SET data = NULL"],
        "data text": ["UPDATE keypoints SET data = 'abc'"], "data number": ["UPDATE keypoints SET data = 5"],
        "data short": [blob.format("keypoints", 7)], "data none": [blob.format("keypoints", 0)],
        "data huge": [blob.format("keypoints", 500_000_000)], "data nan": ["UPDATE keypoints SET data = CAST(replace(hex(zeroblob(320)), '00000000', x'0000c07f') AS BLOB)"],
        "descriptors short": [blob.format("descriptors", 7)], "descriptors columns": ["UPDATE descriptors SET cols = 7"],
        "descriptors null": ["UPDATE descriptors SET data = NULL"], "matches short": ["UPDATE matches SET data = zeroblob(7)"],
        "matches columns": ["UPDATE matches SET cols = 3"], "matches high": ["UPDATE matches SET data = x'ffffffffffffffff', rows = 1"],
        "matches pair": ["UPDATE matches SET pair_id = -5"], "matches pair huge": ["UPDATE matches SET pair_id = 9223372036854775807"],
        "matches rows": ["UPDATE matches SET rows = 1000000000"],
        "endless view": ["ALTER TABLE images RENAME TO old", "CREATE VIEW images AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c) SELECT n AS image_id, '0.jpg' AS name, 1 AS camera_id FROM c"],
        "endless keypoints": ["DROP TABLE keypoints", "CREATE VIEW keypoints AS WITH RECURSIVE c(n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM c) SELECT n AS image_id, 1 AS rows, 4 AS cols, zeroblob(16) AS data FROM c"],
        "view in capitals": ["ALTER TABLE matches RENAME TO old", "CREATE VIEW MATCHES AS WITH RECURSIVE c(n) AS (SELECT 2147483649 UNION ALL SELECT n FROM c) SELECT n AS pair_id, 1 AS rows, 2 AS cols, zeroblob(8) AS data FROM c"],
        "nothing wide": ["UPDATE keypoints SET rows = 10, cols = 0, data = x''"], "matches nothing wide": ["UPDATE matches SET rows = 10, cols = 0, data = x''"],
        "matches itself": ["UPDATE matches SET pair_id = 2147483648"], "rows blob": ["UPDATE keypoints SET rows = randomblob(100000)"],
        **{f"pair {value}": ["CREATE TABLE m AS SELECT * FROM matches", "DROP TABLE matches", "ALTER TABLE m RENAME TO matches", f"UPDATE matches SET pair_id = {value}"] for value in ("'abc'", "NULL", "1e300")},
        "scale nan": ["UPDATE keypoints SET data = CAST(substr(data, 1, 8) || x'0000c07f' || substr(data, 13) AS BLOB)"],
        "view": ["ALTER TABLE images RENAME TO old", "CREATE VIEW images AS SELECT * FROM old"],
        "many images": ["WITH RECURSIVE c(n) AS (SELECT 10 UNION ALL SELECT n + 1 FROM c WHERE n < 200000) INSERT INTO images SELECT n, 'photo' || n, 1 FROM c", "INSERT INTO keypoints SELECT image_id, 0, 4, x'' FROM images WHERE image_id > 9"],
    }  # fmt: skip


def _database(place: Place, statements: list[str], expected: str) -> Trial:
    photos = place.photos()
    path = place.file("bad.db", (place.base / "old.db").read_bytes())
    with sqlite3.connect(path) as connection:
        for statement in statements:
            connection.execute(statement)
    connection.close()
    return Trial(
        arguments=["import", str(photos), "out", "--database", str(path)],
        named=["bad.db"],
        writes=["out"],
        expected=expected,
    )


# labelled pairs -----------------------------------------------------------------------------------------------


def _pairs() -> dict[str, Callable[[h5py.File], object]]:
    found: dict[str, Callable[[h5py.File], object]] = {
        "empty": lambda file: file.clear(),
        "no format": lambda file: file.attrs.__delitem__("format"),
        "version": lambda file: file.attrs.__setitem__("version", 99),
        "format number": lambda file: file.attrs.__setitem__("format", np.arange(3)),
        "scene is data": lambda file: (file.__delitem__("yard"), file.create_dataset("yard", data=[1])),
        "scene in a pipe": lambda file: file.__setitem__("more", _link_to_pipe(file)),
        "name bytes": lambda file: file.create_group(b"\xff"),
        "scene outside": lambda file: (file.__delitem__("yard"), file.__setitem__("yard", h5py.ExternalLink("/etc/passwd", "/"))),
        "camera unknown": lambda file: _replace(file["yard"], "camera_models", [b"MAGIC"] * 4),
        "camera nan": lambda file: _replace(file["yard"], "camera_params", np.full((4, 12), np.nan)),
        "sizes zero": lambda file: _replace(file["yard"], "image_sizes", np.zeros((4, 2), "i4")),
        "poses nan": lambda file: _replace(file["yard"], "rotations", np.full((4, 3, 3), np.nan)),
        "offsets falling": lambda file: _replace(file["yard"], "keypoint_offsets", np.array([0, 200, 100, 50, 240])),
        "offsets huge": lambda file: _replace(file["yard"], "match_offsets", np.array([0, *[2**40] * 6])),
        "pairs high": lambda file: _replace(file["yard"], "pairs", np.full((6, 2), 60000, "u2")),
        "neighbours high": lambda file: _replace(file["yard"], "neighbours", np.full(360, 60000, "u2")),
        "ratios huge": lambda file: _declared(file["yard"], "ratios", (2**36,), "u1"),
    }  # fmt: skip
    for name in ("image_names", "keypoints", "pairs", "neighbours", "mutual", "camera_params"):
        found[f"no {name}"] = lambda file, n=name: file["yard"].__delitem__(n)
        found[f"{name} text"] = lambda file, n=name: _replace(file["yard"], n, np.array([b"a", b"b"]))
        found[f"{name} short"] = lambda file, n=name: _replace(file["yard"], n, file["yard"][n][:1])
    return found


def _labelled(place: Place, spoil: Callable[[h5py.File], object], command: str) -> Trial:
    path = place.file("bad.h5", (place.base / "pairs.h5").read_bytes())
    with h5py.File(path, "r+") as file:
        spoil(file)
    more = {
        "evaluate pose": [str(path), "--method", "mutual/poselib", "--threads", "1"],
        "train run": ["--train-files", str(path), "--max-steps", "1", "--batch-size", "1", "--num-matches", "64", "--output", "out", "--threads", "1"],
        "train plots": ["--pairs", str(path), "--output", "out"],
    }[command]  # fmt: skip
    return Trial(arguments=[*command.split(), *more], named=["bad.h5"], writes=["out"], expected=EITHER)


def _splits() -> dict[str, bytes]:
    return {
        "list": b"[1, 2]", "number": b"3", "text": b'"x"', "null": b"null", "no list": b'{"train": 3}',
        "numbers": b'{"train": [1, 2]}', "lists": b'{"train": [["a"], ["b"]]}', "tables": b'{"train": [{"a": 1}]}',
        "twice": b'{"train": ["a", "a"]}', "above": b'{"train": ["../../etc"]}', "nul": b'{"train": ["a\\u0000b"]}',
        "long": b'{"train": ["' + b"n" * 5000 + b'"]}', "deep": b"[" * 100_000, "deep table": b'{"a":' * 100_000,
        "digits": b"1" * 10_000, "nan": b'{"train": NaN}', "cut": b'{"train": ["a"', "other": b'{"test": []}',
        "surrogate": b'{"train": ["\\ud800"]}', "empty": b'{"train": []}',
    }  # fmt: skip


def _split(place: Place, text: bytes) -> Trial:
    path = place.file("bad.json", text)
    arguments = ["train", "prepare", ".", "--splits", str(path), "--output", "out"]
    return Trial(
        arguments=arguments,
        named=["bad.json", "train", "../../etc", "nnnn", "holds"],
        writes=["out"],
        expected=EITHER,
    )


def _results(place: Place, text: bytes) -> Trial:
    path = place.file("bad.json", text)
    pairs = str(place.base / "pairs.h5")
    arguments = [
        "evaluate",
        "pose",
        pairs,
        "--method",
        "mutual/poselib",
        "--threads",
        "1",
        "--results",
        str(path),
    ]
    return Trial(arguments=arguments, named=["bad.json"], writes=[])
