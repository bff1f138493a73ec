"""Broken COLMAP models, for every command that reads one."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from case import EITHER, Case, Trial
from place import Place

__all__ = ["cases"]

TARGETS = ("splat", "nerfstudio", "colmap", "colmap3", "openmvs", "bundler", "hloc", "csv", "localize")
COMMANDS = ("prepare", "covisible", "score", "compare")


def cases() -> Iterator[Case]:
    """All of them."""
    for label, spoil in _ways().items():
        for command in COMMANDS:
            yield Case(
                name=f"model {command} {label}", prepare=lambda place, s=spoil, c=command: _trial(place, s, c)
            )

    for name in ("../../mine.jpg", "../mine.jpg", "/absolute/mine.jpg", "unknown.jpg", ""):
        for target in TARGETS:
            yield Case(
                name=f"model of {name or 'no name'} for {target}",
                prepare=lambda place, n=name, t=target: _strange_photo(place, n, t),
            )


def _strange_photo(place: Place, name: str, target: str) -> Trial:
    """A photo of the model is called by a path of something else, which must stay as it is."""
    import pycolmap

    scene = place.scene()
    mine = place.file("photos/below/mine.jpg", (place.base / "photos" / "1.jpg").read_bytes())
    place.file("mine.jpg", b"mine")
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    image = min(model.images.values(), key=lambda one: one.name)
    image.name = str(mine) if name.startswith("/") else name
    model.write_binary(scene / "sparse" / "0")
    words = (
        ["localize", str(scene), "photos/1.jpg"]
        if target == "localize"
        else ["export", str(scene), "out", "--for", target]
    )
    return Trial(arguments=words, named=["sparse"], writes=["out"])


def _cut(share: float) -> Callable[[bytes], bytes]:
    return lambda content: content[: int(share * len(content))]


def _count(value: int) -> Callable[[bytes], bytes]:
    return lambda content: struct.pack("<Q", value) + content[8:]


def _ways() -> dict[str, Callable[[Path], None]]:
    def on(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
        def spoil(model: Path) -> None:
            (model / name).write_bytes(change((model / name).read_bytes()))

        return spoil

    def text(**files: str) -> Callable[[Path], None]:
        def spoil(model: Path) -> None:
            for path in model.iterdir():
                path.unlink()
            for name, content in files.items():
                (model / f"{name}.txt").write_text(content)

        return spoil

    found: dict[str, Callable[[Path], None]] = {}
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        short = name.partition(".")[0]
        found |= {
            f"{short} empty": on(name, lambda _: b""),
            f"{short} cut half": on(name, _cut(0.5)),
            f"{short} cut end": on(name, _cut(0.98)),
            f"{short} count huge": on(name, _count(2**63 - 1)),
            f"{short} count large": on(name, _count(2**33)),
            f"{short} count zero": on(name, _count(0)),
            f"{short} noise": on(
                name, lambda content: bytes((i * 97 + 13) % 256 for i in range(len(content)))
            ),
            f"{short} nan": on(name, lambda content: content[:40] + b"\xff" * 64 + content[104:]),
            f"{short} gone": lambda model, n=name: (model / n).unlink(),
        }
    camera = "1 SIMPLE_PINHOLE 160 120 130 80 60\n"
    image = "1 1 0 0 0 0 0 0 1 0.jpg\n10 10 -1\n2 1 0 0 0 1 0 0 1 1.jpg\n10 10 -1\n"
    point = "1 0 0 1 0 0 0 0 1 0 2 0\n"
    return found | {
        "images name bytes": on("images.bin", lambda content: content.replace(b"1.jpg\0", b"\xff\xfejpg\0")),
        "text model unknown": text(cameras="1 MAGIC 160 120 1\n", images=image, points3D=point),
        "text camera few": text(cameras="1 SIMPLE_PINHOLE 160 120 130\n", images=image, points3D=point),
        "text camera nan": text(cameras="1 SIMPLE_PINHOLE 160 120 nan nan nan\n", images=image, points3D=point),
        "text camera zero": text(cameras="1 SIMPLE_PINHOLE 0 0 0 0 0\n", images=image, points3D=point),
        "text camera negative": text(cameras="1 SIMPLE_PINHOLE -160 -120 130 80 60\n", images=image, points3D=point),
        "text no camera": text(cameras="", images=image, points3D=point),
        "text pose nan": text(cameras=camera, images=image.replace(" 0 0 0 0 0 0 ", " nan nan nan nan 0 0 "), points3D=point),
        "text pose zero": text(cameras=camera, images=image.replace("1 1 0 0 0", "1 0 0 0 0"), points3D=point),
        "text letters": text(cameras=camera, images="a b c d\n\n", points3D=point),
        "text point outside": text(cameras=camera, images=image, points3D="1 0 0 1 0 0 0 0 9 9 8 8\n"),
        "text point index": text(cameras=camera, images=image, points3D="1 0 0 1 0 0 0 0 1 999999 2 999999\n"),
        "text name": text(cameras=camera, images=image.replace("0.jpg", "../../etc/passwd"), points3D=point),
        "text name odd": text(cameras=camera, images=image.replace("0.jpg", "\x1b[2J<script>"), points3D=point),
        "text same names": text(cameras=camera, images=image.replace("1.jpg", "0.jpg"), points3D=point),
        "text empty": text(cameras="", images="", points3D=""),
        "text nul": text(cameras="\0\0\0", images="\0\0\0", points3D="\0"),
        "text huge ids": text(cameras=camera.replace("1 S", "99999999999999999999 S"), images=image, points3D=point),
    }  # fmt: skip


def _trial(place: Place, spoil: Callable[[Path], None], command: str) -> Trial:
    if command == "prepare":
        (place.work / "yard").mkdir()
        photos = place.photos(5, "yard/images")
        model = place.model("yard/model")
        arguments = ["train", "prepare", "yard", "--output", "out", "--max-features", "200"]
    elif command == "covisible":
        photos = place.photos(5)
        model = place.model()
        arguments = [
            "extract",
            str(photos),
            "out",
            "--pairing",
            "covisibility",
            "--covisible-model",
            str(model),
        ]
        arguments += ["--max-features", "200", "--threads", "1"]
    elif command == "score":
        scene = place.scene()
        model = place.model()
        arguments = ["evaluate", "scene", str(scene), "--ground-truth", str(model), "--seeds", "1"]
    else:
        photos = place.photos(5)
        model = place.model()
        arguments = ["compare", str(photos), "--output", "out", "--methods", "ratio", "--seeds", "1"]
        arguments += ["--ground-truth", str(model), "--max-features", "200", "--threads", "1"]
    spoil(model)
    return Trial(
        arguments=arguments,
        named=["model", "yard"],
        writes=["out", "scene"],
        expected=EITHER,
        begins=command in ("covisible", "compare"),
    )
