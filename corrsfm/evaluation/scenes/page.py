"""The HTML page of a comparison: its table, and drawings of the pairs that methods differ most on."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.files import atomic_write_text
from corrsfm.report.pictures import draw_matches, jpeg_uri, read_photo
from corrsfm.report.style import frame, section
from corrsfm.types import Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.hloc import FEATURES, MATCHES, PRUNED
from corrsfm.workspace.lists import read_pairs
from corrsfm.workspace.store import ItemStore

__all__ = ["write_page"]

_NUM_DRAWN_PAIRS = 4
_PHOTO_SIZE = 360

_COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], Any], int, int], ...] = (
    # heading, value, decimals, and +1 / -1 where more / less is better
    ("kept matches", lambda m: m["num_kept_matches"], 0, 0),
    ("verified pairs", lambda m: m["num_verified_pairs"], 0, 1),
    ("inlier ratio", lambda m: m["inlier_ratio"], 2, 1),
    ("photos", lambda m: m["num_registered"], 0, 1),
    ("models", lambda m: m["num_models"], 0, 0),
    ("points", lambda m: m["num_points"], 0, 1),
    ("track length", lambda m: m["mean_track_length"], 2, 1),
    ("error px", lambda m: m["mean_error_px"], 2, 0),
    ("prune s", lambda m: m["seconds"]["prune"], 1, -1),
    ("verify s", lambda m: m["seconds"]["verify"], 1, -1),
    ("map s", lambda m: m["seconds"]["map"], 1, -1),
)
_TRUTH_COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], Any], int, int], ...] = (
    ("AUC@1°", lambda m: m["ground_truth"]["auc"]["1"], 1, 1),
    ("AUC@5°", lambda m: m["ground_truth"]["auc"]["5"], 1, 1),
    ("AUC@10°", lambda m: m["ground_truth"]["auc"]["10"], 1, 1),
    ("position error %", lambda m: m["ground_truth"]["position_error_percent"], 2, -1),
)


def write_page(path: Path, values: dict[str, Any], base: Workspace, workspaces: dict[str, Workspace]) -> None:
    """Write the page as one file without links.

    Parameters
    ----------
    path : Path
    values : dict
        Content of the result file of kind ``compare``.
    base : Workspace
        With features and putative matches.
    workspaces : dict
        Workspaces by method.
    """
    subject, provenance = values["subject"], values["provenance"]
    versions = ", ".join(f"{name} {version}" for name, version in provenance["versions"].items())
    subtitle = (
        f"{subject['num_photos']} photos, {subject['num_pairs']} pairs; the same features and matches for "
        "every method. Numbers of the largest model; the best of a column is bold."
    )
    legend = (
        "<p class='note'>By number of verified matches. <span class='kept'>Blue: kept</span>, "
        "<span class='dropped'>orange: dropped</span>; at most 150 and 60 are drawn.</p>"
    )
    drawn = _drawn_pairs(values["pairs"][:_NUM_DRAWN_PAIRS], base, workspaces)
    origin = f"{escape(versions)}; seed {provenance['seed']}. {escape(provenance['command'])}"
    body = [
        section("Methods", _table(values["methods"])),
        section("Pairs that differ most", legend + "\n".join(drawn)),
        f"<p class='note'>{origin}</p>",
    ]
    title = f"{subject['name']}: prune methods compared"
    atomic_write_text(path, frame(title, subtitle, "\n".join(body)))


def _table(methods: dict[str, Any]) -> str:
    columns = list(_COLUMNS)
    if all(method["ground_truth"] for method in methods.values()):
        columns += _TRUTH_COLUMNS
    best = [_best([value(m) for m in methods.values()], sense) for _, value, _, sense in columns]
    head = "".join(f"<th>{escape(heading)}</th>" for heading, *_ in columns)
    rows = []
    for name, method in methods.items():
        cells = []
        for (_, value, decimals, _), winner in zip(columns, best, strict=True):
            number = value(method)
            text = "–" if number is None else f"{number:,.{decimals}f}"
            kind = " class='best'" if number is not None and number == winner else ""
            cells.append(f"<td{kind}>{text}</td>")
        rows.append(f"<tr><td>{escape(name)}</td>{''.join(cells)}</tr>")
        if method["failure"]:
            rows.append(
                f"<tr><td class='failure' colspan='{len(columns) + 1}'>{escape(method['failure'])}</td></tr>"
            )
    head_row = f"<tr><th>method</th>{head}</tr>"
    return f"<div class='scroll'><table class='numbers'>{head_row}{''.join(rows)}</table></div>"


def _best(numbers: Sequence[float | None], sense: int) -> float | None:
    """Best of the numbers; None if all are equal."""
    known = [number for number in numbers if number is not None]
    if sense == 0 or len(set(known)) < 2:
        return None
    return max(known) if sense > 0 else min(known)


def _drawn_pairs(
    rows: Sequence[dict[str, Any]], base: Workspace, workspaces: dict[str, Workspace]
) -> list[str]:
    """A section for each pair, with a picture for each method."""
    oriented = {frozenset(pair): pair for pair in read_pairs(base).pairs}
    features, putative = ItemStore(base.features, FEATURES), ItemStore(base.matches, MATCHES)
    photo = functools.lru_cache(maxsize=2 * _NUM_DRAWN_PAIRS)(
        lambda name: read_photo(base.images_dir / name, _PHOTO_SIZE)
    )
    sections = []
    for row in rows:
        pair = oriented[frozenset((row["name0"], row["name1"]))]
        photos = [photo(name) for name in pair]
        if photos[0] is None or photos[1] is None:
            continue
        indices = putative.read(pair).indices
        points = tuple(features.read(name).keypoints[indices[:, side]] for side, name in enumerate(pair))
        figures = []
        for method, workspace in workspaces.items():
            picture = draw_matches(
                (photos[0][0], photos[1][0]),
                (photos[0][1], photos[1][1]),
                (points[0], points[1]),
                _kept_mask(workspace, pair, indices),
            )
            kept, verified = row["kept_and_verified"][method]
            figures.append(
                f"<figure><img src='{jpeg_uri(picture)}' class='wide' alt='matches kept by {escape(method)}'>"
                f"<figcaption>{escape(method)}: {len(indices)} → {kept} kept → {verified} verified"
                "</figcaption></figure>"
            )
        sections.append(
            f"<h3>{escape(pair[0])} – {escape(pair[1])}</h3><div class='pairs'>{''.join(figures)}</div>"
        )
    return sections


def _kept_mask(workspace: Workspace, pair: Pair, indices: NDArray[np.int32]) -> NDArray[np.bool_]:
    # Column 0 of putative matches strictly increases, so it identifies a match.
    return np.isin(indices[:, 0], ItemStore(workspace.pruned, PRUNED).read(pair).indices[:, 0])
