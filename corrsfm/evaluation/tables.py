"""Tables of documents, rendered from result files.

A document holds pairs of lines ``<!-- table:NAME -->`` and ``<!-- /table -->``; what is between them is the
table of ``results/NAME.json`` and nothing else. A table without a file behind it does not exist.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from corrsfm.errors import InputError
from corrsfm.evaluation.records import load_results
from corrsfm.files import atomic_write_text

__all__ = ["render_document", "render_table", "update_document"]

_BLOCK = re.compile(r"(?P<start><!-- table:(?P<name>[\w.-]+) -->\n).*?(?P<end><!-- /table -->)", re.DOTALL)


def _markdown(header: list[str], rows: list[list[str]]) -> str:
    rule = ["---"] + ["--:"] * (len(header) - 1)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (header, rule, *rows))


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _range(interval: list[float] | None) -> str:
    return "" if interval is None else f" [{interval[1]:.1f}, {interval[2]:.1f}]"


def _difference(interval: list[float] | None) -> str:
    return "–" if interval is None else f"{interval[0]:+.1f} [{interval[1]:+.1f}, {interval[2]:+.1f}]"


def _pose_table(values: dict[str, Any]) -> str:
    header = [
        "filter / estimator", "AUC@5 [95 %]", "AUC@10", "AUC@20", "AUC@5 − baseline", "mAP@5", "precision",
        "recall", "F", "kept", "filter ms", "estimator ms",
    ]  # fmt: skip
    rows = []
    for name, method in values["methods"].items():
        s = method["summary"]
        rows.append(
            [
                name.replace("/", " / ") + (" (baseline)" if name == values["baseline"] else ""),
                _number(s["auc"]["5"]) + _range(s["auc_interval"]["5"]),
                _number(s["auc"]["10"]),
                _number(s["auc"]["20"]),
                _difference(s.get("auc_minus_baseline", {}).get("5")),
                _number(s["map"]["5"]),
                *(_number(s[key]) for key in ("precision", "recall", "f_score")),
                _number(s["num_kept"], 0),
                *(_number(1000.0 * s[key]) for key in ("filter_seconds", "estimator_seconds")),
            ]
        )
    subject = values["subject"]
    caption = (
        f"{subject['num_pairs']} pairs of {len(set(subject['pair_scenes']))} scenes, on average "
        f"{subject['num_matches']:.0f} putative matches, {subject['inlier_percent']:.1f} % of them right. "
        f"{_origin(values)}"
    )
    return f"{_markdown(header, rows)}\n\n{caption}"


def _homography_table(values: dict[str, Any]) -> str:
    header = ["filter", "AUC@3 [95 %]", "AUC@5", "AUC@10", "kept", "failed"]
    rows = []
    for name, method in values["methods"].items():
        s = method["summary"]
        rows.append(
            [
                name,
                _number(s["auc"]["3"]) + _range(s["auc_interval"]["3"]),
                _number(s["auc"]["5"]),
                _number(s["auc"]["10"]),
                _number(s["num_kept"], 0),
                str(s["num_failed"]),
            ]
        )
    count = len(values["subject"]["sequences"])
    return f"{_markdown(header, rows)}\n\n{count} sequences. {_origin(values)}"


def _compare_table(values: dict[str, Any]) -> str:
    truth = any(method.get("ground_truth") for method in values["methods"].values())
    header = [
        "method", "verified pairs", "inlier ratio", "photos", "points", "track length", "error px",
        "prune s", "map s",
    ]  # fmt: skip
    header += ["AUC@1", "AUC@5", "AUC@10", "position error %"] if truth else []
    rows = []
    for name, m in values["methods"].items():
        row = [
            name,
            str(m["num_verified_pairs"]),
            _number(m["inlier_ratio"], 2),
            f"{m['num_registered']}/{values['subject']['num_photos']}",
            str(m["num_points"]),
            _number(m["mean_track_length"], 2),
            _number(m["mean_error_px"], 2),
            _number(m["seconds"]["prune"]),
            _number(m["seconds"]["map"]),
        ]
        if truth:
            score = m.get("ground_truth") or {}
            row += [_number(score.get("auc", {}).get(t)) for t in ("1", "5", "10")]
            row.append(_number(score.get("position_error_percent"), 2))
        rows.append(row)
    return f"{_markdown(header, rows)}\n\n{_origin(values)}"


def _pycolmap_table(values: dict[str, Any]) -> str:
    header = [
        "scene",
        "photos",
        "method",
        "registered",
        "points",
        "median error px",
        "seconds",
        "CPU seconds",
    ]
    rows = [
        [
            row["scene"],
            str(row["photos"]),
            row["method"],
            str(row["registered"]),
            str(row["points"]),
            _number(row["median_error_px"], 2),
            _number(row["seconds"]),
            _number(row["processor_seconds"]),
        ]
        for row in values["rows"]
    ]
    caption = (
        f"Up to {values['subject']['max_features']} features a photo, exhaustive pairs. {_origin(values)}"
    )
    return f"{_markdown(header, rows)}\n\n{caption}"


def _bench_table(values: dict[str, Any]) -> str:
    header = ["matches", "batch", "device", "variant", "pairs/s", "speed ×", "memory ×"]
    rows = [
        [
            str(row["num_matches"]),
            str(row["batch_size"]),
            row["device"],
            row["variant"],
            _number(row["pairs_per_second"], 2),
            _number(row["speed_ratio"], 2),
            _number(row["memory_ratio"], 2),
        ]
        for row in values["rows"]
    ]
    subject, machine = values["subject"], values["provenance"]["machine"]
    caption = f"Network: {subject['model']}. {subject['threads']} threads of {machine['processor']}."
    return f"{_markdown(header, rows)}\n\n{caption}"


def _origin(values: dict[str, Any]) -> str:
    """Where a table comes from: versions and seed, for a caption."""
    versions = values["provenance"]["versions"]
    libraries = ", ".join(
        f"{name} {versions[key]}"
        for name, key in (
            ("corrsfm", "corrsfm"),
            ("OpenCV", "opencv-python-headless"),
            ("pycolmap", "pycolmap"),
            ("PoseLib", "poselib"),
        )
        if key in versions
    )
    return f"{libraries}; seed {values['provenance']['seed']}."


_RENDERERS: dict[str, Callable[[dict[str, Any]], str]] = {
    "pose": _pose_table,
    "homography": _homography_table,
    "compare": _compare_table,
    "pycolmap": _pycolmap_table,
    "bench": _bench_table,
}


def render_table(values: dict[str, Any]) -> str:
    """A result file's content as a Markdown table with its caption.

    Raises
    ------
    InputError
        If there is no table for its kind.
    """
    if values["kind"] not in _RENDERERS:
        raise InputError(f"no table for results of kind {values['kind']}; there are {', '.join(_RENDERERS)}")
    return _RENDERERS[values["kind"]](values)


def render_document(text: str, results_dir: Path, *, where: str = "document") -> str:
    """A document with every table rendered anew.

    Parameters
    ----------
    text : str
    results_dir : Path
        Folder with ``NAME.json``.
    where : str
        The document's name, for messages.

    Raises
    ------
    InputError
        If a table has no result file, or a marker is left open.
    """
    opened, closed = text.count("<!-- table:"), text.count("<!-- /table -->")
    if not opened == closed == len(_BLOCK.findall(text)):
        raise InputError(
            f"{where}: {opened} lines '<!-- table:NAME -->' and {closed} lines '<!-- /table -->'; "
            "they must alternate, each on a line of its own"
        )

    def replace(match: re.Match[str]) -> str:
        table = render_table(load_results(results_dir / f"{match['name']}.json"))
        return f"{match['start']}{table}\n{match['end']}"

    return _BLOCK.sub(replace, text)


def update_document(path: Path, results_dir: Path, *, check: bool = False) -> bool:
    """Render the tables of a document in place.

    Parameters
    ----------
    path : Path
    results_dir : Path
    check : bool
        Change nothing.

    Returns
    -------
    bool
        True if the document differed from its results.

    Raises
    ------
    InputError
        If the document cannot be read or a table has no result file.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    rendered = render_document(text, results_dir, where=str(path))
    if rendered != text and not check:
        atomic_write_text(path, rendered)
    return rendered != text
