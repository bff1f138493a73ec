"""Broken, monstrous and misnamed photos, alone among good ones; their EXIF; their names; videos."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from case import EITHER, FINE, REFUSED, Case, Trial
from place import NUM_PHOTOS, Place

__all__ = ["cases"]

QUICK = ["--max-features", "200", "--threads", "1", "--camera-mode", "per-image"]
EXTENSIONS = ("jpg", "png", "tif", "bmp", "webp", "heic", "avif")


def cases() -> Iterator[Case]:
    """All of them, each seen by the commands that read photos."""
    for label, (name, content) in _broken().items():
        for command in ("extract", "skip", "check"):
            yield _case(f"photo {label} {command}", name, content, command, REFUSED)
    for label, (name, content) in _odd().items():
        for command in ("extract", "check"):
            yield _case(f"photo {label} {command}", name, content, command, EITHER)
    for label in ("cut-half", "bomb", "empty", "noise"):
        name, content = _broken()[f"{label} jpg" if label != "bomb" else "bomb png"]
        yield Case(name=f"photo {label} add", prepare=lambda place, n=name, c=content: _add(place, n, c))
        yield Case(
            name=f"photo {label} localize", prepare=lambda place, n=name, c=content: _find(place, n, c)
        )
    for label, (_, content) in _broken().items():
        for command in AFTERWARDS:
            yield Case(
                name=f"photo {label} after a run {command}",
                prepare=lambda place, c=content, n=command: _changed_since(place, c, n),
            )
    for label, change in _exif().items():
        yield Case(name=f"exif {label}", prepare=lambda place, c=change: _with_exif(place, c))
    for label, name in _names().items():
        yield Case(name=f"name {label}", prepare=lambda place, n=name: _named(place, n))
    for label, content in _videos().items():
        yield Case(name=f"video {label}", prepare=lambda place, c=content: _video(place, c))
    for label, name in {"mask size": "size", "mask noise": "noise", "mask bomb": "bomb"}.items():
        yield Case(name=label, prepare=lambda place, n=name: _mask(place, n))


Content = Callable[[], bytes]

AFTERWARDS = {
    "splat": ["export", "scene", "out", "--for", "splat"],
    "nerfstudio": ["export", "scene", "out", "--for", "nerfstudio"],
    "colmap": ["export", "scene", "out", "--for", "colmap"],
    "reconstruct": ["reconstruct", "scene", "--overwrite", "--threads", "1"],
    "report": ["report", "scene"],
    "check": ["check", "scene"],
}
"""Commands on a finished scene that look at its photos."""


def _changed_since(place: Place, content: Content, command: str) -> Trial:
    """A photo that is no longer what was reconstructed: no export may hold it, the rest does without."""
    place.scene()
    place.file("photos/1.jpg", content())
    return Trial(
        arguments=AFTERWARDS[command],
        named=["1.jpg"],
        writes=["out", "scene"] if command in ("reconstruct", "report") else ["out"],
        expected=EITHER if command in ("reconstruct", "report", "check") else REFUSED,
        begins=True,
    )


def _case(label: str, name: str, content: Content, command: str, expected: str) -> Case:
    def prepare(place: Place) -> Trial:
        photos = place.photos()
        place.file(f"photos/{name}", content())
        arguments = {
            "extract": ["extract", str(photos), "out", *QUICK],
            "skip": ["extract", str(photos), "out", "--skip-unreadable", *QUICK],
            "check": ["check", str(photos), "--no-forecast", "--threads", "1"],
        }[command]
        outcome = FINE if command == "skip" else expected
        # Some photos break only when they are decoded; the features of the others are kept then.
        return Trial(arguments=arguments, named=[name], writes=["out"], expected=outcome, begins=True)

    return Case(name=label, prepare=prepare)


def _picture(width: int = 160, height: int = 120) -> np.ndarray:
    rng = np.random.default_rng(0)
    return cv2.resize(rng.integers(0, 256, (12, 16, 3), np.uint8), (width, height))


def _encoded(extension: str) -> bytes:
    if extension in ("heic", "avif"):
        import io

        from PIL import Image
        from pillow_heif import register_heif_opener

        register_heif_opener()
        stream = io.BytesIO()
        Image.fromarray(_picture()).save(stream, "HEIF" if extension == "heic" else "AVIF")
        return stream.getvalue()
    ok, encoded = cv2.imencode(f".{extension}", _picture())
    assert ok
    return encoded.tobytes()


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def _png(width: int, height: int, content: bytes, *, depth: int = 8, colour: int = 2) -> bytes:
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", content) + _chunk(b"IEND", b"")


def _bomb(width: int, height: int, depth: int = 8, colour: int = 2) -> bytes:
    """A PNG of zeros, a few MB that become GB."""
    bits = depth * {0: 1, 2: 3, 6: 4}[colour]
    line = bytes(1 + (width * bits + 7) // 8)
    squeeze = zlib.compressobj(9)
    parts = [squeeze.compress(line * 64) for _ in range(height // 64)]
    return _png(width, height, b"".join([*parts, squeeze.flush()]), depth=depth, colour=colour)


def _tiff(width: int, height: int, *, offset: int = 8, next_ifd: int = 0) -> bytes:
    tags = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 200), (277, 1), (278, height),
            (279, min(width * height, 2**32 - 1))]  # fmt: skip
    body = struct.pack("<H", len(tags)) + b"".join(
        struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags
    )
    return b"II*\0" + struct.pack("<I", offset) + body + struct.pack("<I", next_ifd) + bytes(500)


def _bmp(width: int, height: int, bits: int = 24) -> bytes:
    return struct.pack(
        "<2sIHHIIiiHHIIiiII", b"BM", 1000, 0, 0, 54, 40, width, height, 1, bits, 0, 0, 0, 0, 0, 0
    ) + bytes(500)


def _jpeg_of_size(width: int, height: int) -> bytes:
    """A real JPEG whose header says another size."""
    content = bytearray(_encoded("jpg"))
    start = content.index(b"\xff\xc0")
    content[start + 5 : start + 9] = struct.pack(">HH", height, width)
    return bytes(content)


def _webp_of_size(width: int, height: int) -> bytes:
    flags = struct.pack("<I", 0) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    body = b"WEBPVP8X" + struct.pack("<I", 10) + flags + bytes(100)
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _broken() -> dict[str, tuple[str, Content]]:
    """Label → name and content of files that are no photo that can be used."""
    found: dict[str, tuple[str, Content]] = {}
    for extension in EXTENSIONS:
        name = f"bad.{extension}"
        ways: dict[str, Callable[[bytes], bytes]] = {
            "empty": lambda _: b"",
            "one-byte": lambda content: content[:1],
            "head": lambda content: content[:16],
            "cut-tenth": lambda content: content[: len(content) // 10],
            "cut-half": lambda content: content[: len(content) // 2],
            "zeros": lambda content: bytes(len(content)),
            "noise": lambda content: np.random.default_rng(1).bytes(len(content)),
            "text": lambda _: b"404 not found\n" * 20,
            "html": lambda _: b"<!DOCTYPE html><html><script>alert(1)</script></html>",
        }
        for label, way in ways.items():
            found[f"{label} {extension}"] = name, lambda e=extension, w=way: w(_encoded(e))
    found |= {
        "bomb png": ("bad.png", lambda: _bomb(30000, 30000)),
        "bomb-16-bit png": ("bad.png", lambda: _bomb(20000, 20000, 16, 6)),
        "bomb-named-jpg png": ("bad.jpg", lambda: _bomb(30000, 30000)),
        "widest png": ("bad.png", lambda: _png(2**31 - 1, 1, zlib.compress(bytes(1000)))),
        "largest png": ("bad.png", lambda: _png(2**31 - 1, 2**31 - 1, zlib.compress(bytes(1000)))),
        "no-pixel png": ("bad.png", lambda: _png(0, 0, zlib.compress(b""))),
        "largest tif": ("bad.tif", lambda: _tiff(2**32 - 1, 2**32 - 1)),
        "large tif": ("bad.tif", lambda: _tiff(60000, 60000)),
        "loop tif": ("bad.tif", lambda: _tiff(0, 0, next_ifd=8)),
        "outside tif": ("bad.tif", lambda: _tiff(100, 100, offset=2**31)),
        "largest bmp": ("bad.bmp", lambda: _bmp(2**31 - 1, 2**31 - 1)),
        "negative bmp": ("bad.bmp", lambda: _bmp(-100, -(2**31))),
        "large bmp": ("bad.bmp", lambda: _bmp(60000, 60000, 1)),
        "largest jpg": ("bad.jpg", lambda: _jpeg_of_size(65535, 65535)),
        "no-pixel jpg": ("bad.jpg", lambda: _jpeg_of_size(0, 0)),
        "largest webp": ("bad.webp", lambda: _webp_of_size(2**24, 2**24)),
        "pdf": ("bad.jpg", lambda: b"%PDF-1.7\n" + bytes(1000)),
        "elf": ("bad.jpg", lambda: b"\x7fELF" + bytes(1000)),
        "zip": ("bad.png", lambda: b"PK\x03\x04" + bytes(1000)),
        "svg": ("bad.png", lambda: b'<svg xmlns="http://www.w3.org/2000/svg" width="99999" height="99999"/>'),
        "ps": ("bad.tif", lambda: b"%!PS-Adobe-3.0 EPSF-3.0\n(/etc/passwd) (r) file\n"),
        "ppm": ("bad.jpg", lambda: b"P6 30000 30000 255\n" + bytes(3000)),
        "sparse": ("bad.jpg", lambda: b"\xff\xd8\xff\xe0" + bytes(200_000_000)),
    }  # fmt: skip
    return found


def _odd() -> dict[str, tuple[str, Content]]:
    """Label → photos that are unusual, and may be used or refused."""

    def written(extension: str, image: np.ndarray, *options: int) -> Content:
        return lambda: cv2.imencode(extension, image, list(options))[1].tobytes()

    rng = np.random.default_rng(2)
    flipped = bytearray(_encoded("jpg"))
    for place in rng.integers(200, len(flipped) - 2, 30):
        flipped[place] ^= 1 << int(rng.integers(8))
    grey = _picture()[:, :, 0]
    found: dict[str, tuple[str, Content]] = {
        "flipped jpg": ("odd.jpg", lambda: bytes(flipped)),
        "tail jpg": ("odd.jpg", lambda: _encoded("jpg") + bytes(100_000)),
        "other-suffix": ("odd.jpg", lambda: _encoded("png")),
        "one-pixel": ("odd.png", written(".png", grey[:1, :1])),
        "one-row": ("odd.png", written(".png", grey[:1])),
        "one-column": ("odd.png", written(".png", np.ascontiguousarray(grey[:, :1]))),
        "two-pixels": ("odd.png", written(".png", grey[:2, :2])),
        "fifteen": ("odd.png", written(".png", grey[:15, :15])),
        "long": ("odd.png", written(".png", np.zeros((1, 60000), np.uint8))),
        "high": ("odd.png", written(".png", np.zeros((60000, 2), np.uint8))),
        "black": ("odd.png", written(".png", np.zeros((120, 160), np.uint8))),
        "white": ("odd.png", written(".png", np.full((120, 160, 3), 255, np.uint8))),
        "sixteen-bit": ("odd.png", written(".png", grey.astype(np.uint16) * 257)),
        "twelve-bit": ("odd.tif", written(".tif", grey.astype(np.uint16) * 16)),
        "alpha": ("odd.png", written(".png", np.dstack([_picture(), grey]))),
        "float": ("odd.tif", written(".tif", grey.astype(np.float32) / 255)),
        "float-nan": ("odd.tif", written(".tif", np.full((120, 160), np.nan, np.float32))),
        "double": ("odd.tif", written(".tif", grey.astype(np.float64))),
        "progressive": ("odd.jpg", written(".jpg", _picture(), cv2.IMWRITE_JPEG_PROGRESSIVE, 1)),
        "cut-end jpg": ("odd.jpg", lambda: _encoded("jpg")[:-40]),
        "cut-end png": ("odd.png", lambda: _encoded("png")[:-20]),
        "bad-crc png": ("odd.png", lambda: _encoded("png").replace(b"IDAT", b"IDAT", 1)[:-5] + b"\0" * 5),
        "upper": ("ODD.JPG", lambda: _encoded("jpg")),
        "gif": ("odd.jpg", lambda: b"GIF89a\xff\xff\xff\xff\x80\0\0\0\0\0\xff\xff\xff,\0\0\0\0\xff\xff\xff\xff\0\2\2D\1\0;"),
    }  # fmt: skip
    return found


def _add(place: Place, name: str, content: Content) -> Trial:
    new = place.file(f"new/{name}", content())
    scene = place.scene()
    return Trial(arguments=["add", str(scene), str(new), "--threads", "1"], named=[name], writes=[])


def _find(place: Place, name: str, content: Content) -> Trial:
    new = place.file(f"new/{name}", content())
    arguments = ["localize", str(place.scene()), str(new), "--threads", "1"]
    return Trial(arguments=arguments, named=[name], writes=[])


def _exif_block(entries: list[tuple[int, int, int, bytes]], gps: list[tuple[int, int, int, bytes]]) -> bytes:
    """EXIF of raw entries: tag, type, count, value or its content."""

    def directory(rows: list[tuple[int, int, int, bytes]], offset: int) -> bytes:
        head, tail = struct.pack("<H", len(rows)), b""
        after = offset + 2 + 12 * len(rows) + 4
        for tag, kind, count, value in rows:
            if len(value) > 4:
                head += struct.pack("<HHII", tag, kind, count, after + len(tail))
                tail += value
            else:
                head += struct.pack("<HHI", tag, kind, count) + value.ljust(4, b"\0")
        return head + bytes(4) + tail

    rows = [*entries, (0x8825, 4, 1, b"\0\0\0\0")] if gps else entries
    first = directory(rows, 8)
    if gps:
        rows[-1] = (0x8825, 4, 1, struct.pack("<I", 8 + len(first)))
        first = directory(rows, 8)
    return b"Exif\0\0II*\0" + struct.pack("<I", 8) + first + (directory(gps, 8 + len(first)) if gps else b"")


def _rational(*values: tuple[int, int]) -> bytes:
    return b"".join(struct.pack("<II", *value) for value in values)


def _exif() -> dict[str, bytes]:
    """Label → nonsense in place of EXIF."""

    def place(
        latitude: bytes, longitude: bytes, altitude: bytes = _rational((1, 1)), ref: bytes = b"N"
    ) -> bytes:
        return _exif_block(
            [], [(1, 2, 2, ref + b"\0"), (2, 5, 3, latitude), (3, 2, 2, b"E\0"), (4, 5, 3, longitude),
                 (6, 5, 1, altitude)],
        )  # fmt: skip

    good = _rational((40, 1), (0, 1), (0, 1))
    texts = {
        "script": b"<script>alert(1)</script>", "escape": b"\x1b[2J\x07", "breaks": b"a\nb\tc\r", "latin": b"\xff\xfe",
        "long": b"x" * 60000, "format": b"%s%n{0}", "nothing": b"",
    }  # fmt: skip
    return {
        **{f"make {label}": _exif_block([(0x10F, 2, len(text) + 1, text + b"\0")], []) for label, text in texts.items()},
        **{
            f"orientation {value}": _exif_block([(0x112, 3, 1, struct.pack("<HH", value, 0))], [])
            for value in (0, 9, 255, 65535)
        },
        "orientation text": _exif_block([(0x112, 2, 4, b"top\0")], []),
        **{
            f"focal {label}": _exif_block([(0x920A, 5, 1, _rational(value)), (0xA405, 3, 1, struct.pack("<HH", mm, 0))], [])
            for label, value, mm in (
                ("zero", (0, 1), 0), ("0/0", (0, 0), 0), ("1/0", (1, 0), 0), ("huge", (2**32 - 1, 1), 65535),
                ("tiny", (1, 2**32 - 1), 1),
            )
        },
        "gps north-pole": place(_rational((90, 1), (0, 1), (0, 1)), good),
        "gps beyond": place(_rational((91, 1), (0, 1), (0, 1)), good),
        "gps 0/0": place(_rational((0, 0), (0, 0), (0, 0)), good),
        "gps 1/0": place(_rational((1, 0), (1, 0), (1, 0)), good),
        "gps huge": place(_rational((2**32 - 1, 1), (2**32 - 1, 1), (2**32 - 1, 1)), good),
        "gps height 1/0": place(good, good, _rational((1, 0))),
        "gps height huge": place(good, good, _rational((2**32 - 1, 1))),
        "gps no-ref": place(good, good, ref=b"?"),
        "gps short": _exif_block([], [(2, 5, 1, _rational((40, 1)))]),
        "count huge": _exif_block([(0x10F, 2, 2**32 - 1, b"abcdefgh")], []),
        "offset outside": b"Exif\0\0II*\0" + struct.pack("<I", 2**31),
        "loop": b"Exif\0\0II*\0\x08\0\0\0\0\0\x08\0\0\0",
        "loop gps": b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHII", 0x8825, 4, 1, 8) + bytes(4),
        "many entries": b"Exif\0\0II*\0\x08\0\0\0\xff\xff" + bytes(5000),
        "empty": b"Exif\0\0",
        "cut": b"Exif\0\0II*\0\x08",
        "noise": b"Exif\0\0" + np.random.default_rng(3).bytes(3000),
        "xmp": b"http://ns.adobe.com/xap/1.0/\0" + b'<!DOCTYPE x [<!ENTITY a "aaaa">]>' + b"<x>&a;</x>" * 5000,
        "icc": b"ICC_PROFILE\0\x01\x01" + np.random.default_rng(4).bytes(3000),
    }  # fmt: skip


def _with_exif(place: Place, block: bytes) -> Trial:
    photos = place.photos(NUM_PHOTOS)
    for number in (1, 2):
        path = photos / f"{number}.jpg"
        jpeg = path.read_bytes()
        segment = b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block
        path.write_bytes(jpeg[:2] + segment + jpeg[2:])
    arguments = ["run", str(photos), "out", "--max-features", "200", "--threads", "1", "--pairing", "spatial",
                 "--pairing", "exhaustive"]  # fmt: skip
    return Trial(
        arguments=arguments, named=["1.jpg", "photos", "out"], writes=["out"], expected=EITHER, begins=True
    )


def _names() -> dict[str, bytes]:
    return {
        "line-break": b"bad\nname.jpg", "return": b"bad\rname.jpg", "tab": b"bad\tname.jpg", "escape": b"bad\x1b[2J.jpg",
        "bell": b"bad\x07.jpg", "latin": b"bad\xe9.jpg", "surrogate": b"bad\xed\xa0\x80.jpg", "separator": "bad\u2028.jpg".encode(),
        "next-line": "bad\x85.jpg".encode(), "delete": b"bad\x7f.jpg",
        "longest": b"b" * 251 + b".jpg", "dash": b"-rf.jpg", "dashes": b"--help.jpg", "spaces": b" a  b .jpg",
        "quotes": b"a'b\"c.jpg", "shell": b"$(touch hacked);`touch hacked`.jpg", "star": b"*.jpg", "brackets": b"[a-z].jpg",
        "percent": b"%s%d%n.jpg", "braces": b"{0}{x}.jpg", "html": b"<script>alert(1)<!--.jpg", "entity": b"&lt;b&gt;.jpg",
        "backslash": b"a\\b.jpg", "dots": b"...a..jpg", "hash": b"#a.jpg", "question": b"a?b=c.jpg", "colon": b"C:a.jpg",
        "emoji": "📷.jpg".encode(), "combining": "e\u0301.jpg".encode(), "right-to-left": "a\u202egpj.jpg".encode(),
        "wide": "写真.jpg".encode(), "device": b"CON.jpg", "comma": b"a,b;c.jpg", "only-suffix": b"x.jpg.jpg.jpg",
        "json": b'"}],"a":[{".jpg', "sql": b"'); DROP TABLE images;--.jpg",
    }  # fmt: skip


def _named(place: Place, name: bytes) -> Trial:
    photos = place.photos(NUM_PHOTOS)
    os.rename(photos / "2.jpg", os.path.join(os.fsencode(photos), name))
    shown = name.decode("utf-8", "surrogateescape")
    control = any(
        ord(letter) < 32 or 127 <= ord(letter) < 160 or letter in "\u2028\udce9\udced" for letter in shown
    )
    arguments = ["run", str(photos), "out", "--max-features", "200", "--threads", "1"]
    return Trial(
        arguments=arguments,
        named=[shown, ascii(shown)[1:-1]],
        writes=["out"],
        expected=REFUSED if control else FINE,
    )


def _videos() -> dict[str, bytes]:
    playlist = b"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile:///etc/passwd\n#EXT-X-ENDLIST\n"
    return {
        "empty": b"", "noise": np.random.default_rng(5).bytes(20000), "text": b"no video\n" * 50,
        "head": b"\0\0\0 ftypisom\0\0\2\0isomiso2avc1mp41", "photo": _encoded("jpg"),
        "playlist": playlist, "playlist-net": playlist.replace(b"file:///etc/passwd", b"http://127.0.0.1:9/x.ts"),
        "concat": b"ffconcat version 1.0\nfile /etc/passwd\n", "sdp": b"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nt=0 0\nm=video 9 RTP/AVP 96\n",
        "huge-atom": b"\0\0\0\x01ftyp" + b"\xff" * 8 + bytes(100), "avi": b"RIFF\xff\xff\xff\xffAVI LIST" + bytes(200),
        "mkv": b"\x1aE\xdf\xa3" + b"\xff" * 100,
    }  # fmt: skip


def _video(place: Place, content: bytes) -> Trial:
    video = place.file("bad.mp4", content)
    arguments = ["extract", str(video), "out", "--threads", "1"]
    return Trial(arguments=arguments, named=["bad.mp4"], writes=["out"])


def _mask(place: Place, kind: str) -> Trial:
    photos = place.photos()
    masks = place.work / "masks"
    masks.mkdir()
    name = "1.jpg.png"
    content = {"size": _encoded("png")[:0] or cv2.imencode(".png", np.zeros((9, 9), np.uint8))[1].tobytes()}
    content |= {"noise": b"noise" * 100}
    place.file(f"masks/{name}", _bomb(30000, 30000) if kind == "bomb" else content[kind])
    arguments = ["extract", str(photos), "out", "--mask-dir", str(masks), "--threads", "1"]
    return Trial(arguments=arguments, named=[name], writes=["out"], begins=True)
