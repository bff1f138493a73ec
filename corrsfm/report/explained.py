"""What the first model explains, pair by pair: a matrix of photos, and the pairs that contradict it."""

from __future__ import annotations

import html
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.report import charts, pictures
from corrsfm.report.statistics import SceneReport

__all__ = ["LoadVerified", "explained_pairs", "photos_to_show"]

LoadVerified = Callable[[str, str], tuple[NDArray[np.float32], NDArray[np.float32]]]
"""Names of a pair → its verified matches, in the order of the record: points in photo 0 and in photo 1,
(K, 2) float32 pixels in COLMAP's convention."""

MAX_PHOTOS = 200
_DRAWN_PAIRS, _DRAWN_FOLDED = 6, 3
_LISTED_PAIRS = 300
_MOST_LINES = 150

Record = Mapping[str, Any]

# Names the pair under the pointer below the matrix; without scripts the matrix is a still picture.
_SCRIPT = """
(function () {
  const data = JSON.parse(document.getElementById("pair-data").textContent);
  const figure = document.getElementById("pair-matrix");
  const picture = figure.querySelector("image");
  const readout = document.getElementById("pair-readout");
  const texts = new Map(data.pairs.map(([i, j, text]) => [i + " " + j, text]));
  function show(event) {
    const box = picture.getBoundingClientRect(), count = data.names.length;
    const column = Math.floor((event.clientX - box.left) / box.width * count);
    const row = Math.floor((event.clientY - box.top) / box.height * count);
    if (Math.min(row, column) < 0 || Math.max(row, column) >= count || row === column) return;
    const text = texts.get(Math.min(row, column) + " " + Math.max(row, column)) || "no verified match";
    readout.textContent = data.names[row] + " \\u2013 " + data.names[column] + ": " + text;
  }
  figure.addEventListener("pointermove", show);
  figure.addEventListener("pointerdown", show);
})();
"""


def explained_pairs(
    report: SceneReport, images_dir: Path | None = None, load_verified: LoadVerified | None = None
) -> str:
    """The section's HTML; empty where nothing is on record.

    Parameters
    ----------
    report : SceneReport
    images_dir : Path, optional
        Folder of the photos; contradicted pairs are drawn if it and ``load_verified`` are given.
    load_verified : callable, optional
    """
    known = set(report.image_names)
    pairs = [
        pair
        for pair in report.evidence.get("pairs", [])
        if pair["num_verified"] and pair["name0"] in known and pair["name1"] in known
    ]
    if not pairs:
        return ""
    contradicted = report.evidence.get("contradicted_pairs", [])
    drawn = ""
    if images_dir is not None and load_verified is not None:
        folds = report.evidence.get("folds", {})
        apart = folds.get("worst_pairs", [])[:_DRAWN_FOLDED] if folds.get("folded") else []
        drawn = _folded(apart, images_dir, load_verified) + _drawn(contradicted, images_dir, load_verified)
    return (
        _summary(pairs, contradicted) + _matrix(report, pairs, contradicted) + drawn + _listed(contradicted)
    )


def photos_to_show(
    names: Sequence[str], contradicted: Sequence[Record], pairs: Sequence[Record], most: int = MAX_PHOTOS
) -> list[str]:
    """All photos of a scene, or those with most contradicted matches, and next most unexplained ones.

    Parameters
    ----------
    names : sequence of str
    contradicted, pairs : sequence of dict
        Of the record: ``name0``, ``name1``, ``num_verified``, ``num_explained``.
    most : int

    Returns
    -------
    list of str
        In the order of ``names``.
    """
    if len(names) <= most:
        return list(names)
    against, unexplained = Counter[str](), Counter[str]()
    for counts, counted in ((against, contradicted), (unexplained, pairs)):
        for pair in counted:
            for name in (pair["name0"], pair["name1"]):
                counts[name] += pair["num_verified"] - pair["num_explained"]
    ranked = sorted(names, key=lambda name: (-against[name], -unexplained[name]))
    chosen = set(ranked[:most])
    return [name for name in names if name in chosen]


def _summary(pairs: Sequence[Record], contradicted: Sequence[Record]) -> str:
    num_verified = sum(pair["num_verified"] for pair in pairs)
    num_explained = sum(pair["num_explained"] for pair in pairs)
    # Rounded down, as in the verdict.
    percent = 1000 * num_explained // num_verified / 10
    text = (
        f"The model's cameras agree with {num_explained:,} of {num_verified:,} verified matches "
        f"({percent:.1f} %). "
    )
    if not contradicted:
        return f"<p>{text}No pair contradicts it.</p>"
    count = f"{len(contradicted):,} of {len(pairs):,} verified pairs"
    return (
        f"<p>{text}<b>{count}</b> contradict{'s' if len(contradicted) == 1 else ''} it: the model explains "
        "less than half of their matches.</p>"
    )


def _matrix(report: SceneReport, pairs: Sequence[Record], contradicted: Sequence[Record]) -> str:
    names = photos_to_show(report.image_names, contradicted, pairs)
    position = {name: index for index, name in enumerate(names)}
    against = {(pair["name0"], pair["name1"]) for pair in contradicted}
    cells: list[tuple[str, str, float | None]] = []
    marks: list[tuple[int, int]] = []
    texts: dict[tuple[int, int], str] = {}
    for pair in pairs:
        names_of_pair = name0, name1 = pair["name0"], pair["name1"]
        if name0 not in position or name1 not in position:
            continue
        row, column = sorted((position[name0], position[name1]))
        share = pair["num_explained"] / pair["num_verified"] if pair["registered"] else None
        cells.append((name0, name1, share))
        texts[row, column] = _text_of(pair, share, names_of_pair in against)
        if names_of_pair in against:
            marks += [(row, column), (column, row)]
    left_out = report.evidence.get("folds", {}).get("left_out", [])
    for name0, name1 in left_out:
        if name0 in position and name1 in position:
            row, column = sorted((position[name0], position[name1]))
            texts[row, column] = "left out, because it joins places that look alike"
            cells.append((name0, name1, None))
    data = {"names": names, "pairs": [[row, column, text] for (row, column), text in texts.items()]}
    # A name may hold "</script>".
    embedded = json.dumps(data, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    number_of = {name: number for number, name in enumerate(report.image_names, 1)}
    drawn = charts.matrix(
        pictures.png_uri(pictures.draw_shares(names, cells)),
        names,
        f"share of verified matches that the model explains, for the pairs of {len(names)} photos",
        numbers=[number_of[name] for name in names],
        marks=marks,
    )
    return (
        f'<div class="graph"><figure id="pair-matrix">{drawn}</figure>'
        f"<div>{_legend(report, names, bool(contradicted))}</div></div>\n"
        f'<script type="application/json" id="pair-data">{embedded}</script>\n<script>{_SCRIPT}</script>'
    )


def _text_of(pair: Record, share: float | None, contradicts: bool) -> str:
    if share is None:
        return f"{pair['num_verified']:,} verified; not both photos are in the model"
    text = f"{pair['num_explained']:,} of {pair['num_verified']:,} verified matches explained"
    return text + (", contradicts the model" if contradicts else "")


def _legend(report: SceneReport, names: Sequence[str], has_contradicted: bool) -> str:
    ramp = pictures.png_uri(pictures.share_colours(np.linspace(0, 1, 128)[None]))
    parts = ["<p>Rows and columns are photos in order of their names; each cell is a pair.</p>"]
    if len(names) < len(report.image_names):
        parts.append(
            f"<p><b>{len(names)} of {len(report.image_names):,} photos are shown</b>: those with most "
            "contradicted matches. All pairs are in evidence.json.</p>"
        )
    parts += [
        '<p class="readout" id="pair-readout" aria-live="polite">Point at a cell to read its pair.</p>',
        '<p class="legend">explained <span>none</span>'
        f'<img src="{ramp}" alt="red to green"><span>all</span></p>',
    ]
    if has_contradicted:
        parts.append('<p class="legend"><i class="crossed">×</i> contradicts the model: less than half</p>')
    parts += [
        '<p class="legend"><i class="grey"></i> not in the model, or left out</p>',
        '<p class="legend"><i class="white"></i> no verified match</p>',
    ]
    if has_contradicted:
        parts.append(
            '<p class="note">A row of mostly crosses is a photo that probably stands in the wrong place. Two '
            "groups of photos with crosses only between them may be two places that look alike, laid over "
            "each other. Single crosses are mostly false matches.</p>"
        )
    if len(names) > charts.MOST_NAMES:
        numbers = {name: number for number, name in enumerate(report.image_names, 1)}
        listed = "".join(f'<li value="{numbers[name]}">{html.escape(name)}</li>' for name in names)
        parts.append(f"<details><summary>Numbers and names</summary><ol>{listed}</ol></details>")
    return "".join(parts)


def _folded(apart: Sequence[Record], images_dir: Path, load_verified: LoadVerified) -> str:
    """The pairs for which a model is taken to be folded, with all their verified matches."""
    figures = []
    for pair in apart:
        points = load_verified(pair["name0"], pair["name1"])
        explained = np.ones(len(points[0]), bool)
        figures.append(_figure(pair, points, explained, f"{len(explained):,} verified matches", images_dir))
    return _figures(
        "Side by side in the model, but without common matches where both should see the same",
        "If these photos were taken from different places, the model is folded there.",
        f'<i style="background:{pictures.KEPT_COLOUR}"></i> verified; at most {_MOST_LINES} lines are drawn',
        figures,
    )


def _drawn(contradicted: Sequence[Record], images_dir: Path, load_verified: LoadVerified) -> str:
    """The least explained pairs with their verified matches, if the record tells which are explained."""
    figures = []
    for pair in contradicted[:_DRAWN_PAIRS]:
        explained = np.array([digit == "1" for digit in pair.get("explained_matches", "")], bool)
        points = load_verified(pair["name0"], pair["name1"])
        if len(explained) and len(explained) == len(points[0]):
            text = f"{pair['num_explained']:,} of {pair['num_verified']:,} verified matches explained"
            figures.append(_figure(pair, points, explained, text, images_dir))
    return _figures(
        "The contradicted pairs" if len(contradicted) <= _DRAWN_PAIRS else "The least explained pairs",
        "Look at what the unexplained lines join. If it is the same spot in both photos, one of the two "
        "cameras stands in the wrong place. If it is two spots that look alike, the matches are false and "
        "the model may be right.",
        f'<i style="background:{pictures.KEPT_COLOUR}"></i> explained '
        f'<i style="background:{pictures.DROPPED_COLOUR}"></i> not explained; '
        f"at most {_MOST_LINES} lines of each are drawn",
        figures,
    )


def _figure(
    pair: Record,
    points: tuple[NDArray[np.float32], NDArray[np.float32]],
    explained: NDArray[np.bool_],
    text: str,
    images_dir: Path,
) -> str:
    """A pair with its matches and a caption; empty if a photo cannot be read."""
    paths = (images_dir / pair["name0"], images_dir / pair["name1"])
    uri = pictures.matches_uri(paths, points, explained, most=(_MOST_LINES, _MOST_LINES))
    if uri is None:
        return ""
    names = html.escape(f"{pair['name0']} – {pair['name1']}")
    caption = f"<figcaption><b>{names}</b> {text}</figcaption>"
    return f'<figure><img class="wide" src="{uri}" alt="">{caption}</figure>'


def _figures(title: str, note: str, legend: str, figures: Sequence[str]) -> str:
    if not any(figures):
        return ""
    return (
        f'<h3>{title}</h3><p class="note">{note}</p><p class="legend">{legend}</p>'
        f'<div class="pairs">{"".join(figures)}</div>'
    )


def _listed(contradicted: Sequence[Record]) -> str:
    if not contradicted:
        return ""
    rows = "".join(
        f"<tr><td>{html.escape(pair['name0'])}</td><td>{html.escape(pair['name1'])}</td>"
        f"<td>{pair['num_verified']:,}</td><td>{pair['num_explained']:,}</td></tr>"
        for pair in contradicted[:_LISTED_PAIRS]
    )
    count = f"Contradicted pairs: {len(contradicted):,}"
    if len(contradicted) > _LISTED_PAIRS:
        count = f"The {_LISTED_PAIRS} least explained of {len(contradicted):,} pairs; all are in report.json"
    head = "<tr><th>photo 0</th><th>photo 1</th><th>verified</th><th>explained</th></tr>"
    return (
        f'\n<details><summary>{count}</summary><div class="scroll tall">'
        f'<table class="numbers names">{head}{rows}</table></div></details>'
    )
