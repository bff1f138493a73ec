"""A self-contained HTML page about a scene: statistics, pictures and the model in 3-D."""

from __future__ import annotations

import html
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from corrsfm.colmap.models import observation_errors
from corrsfm.errors import DependencyError
from corrsfm.files import atomic_write_text
from corrsfm.report import charts, pictures
from corrsfm.report.explained import LoadVerified, explained_pairs
from corrsfm.report.missing import MissingPhoto
from corrsfm.report.model_view import ModelView, make_view, plotly_view
from corrsfm.report.statistics import SceneReport
from corrsfm.report.style import frame, section
from corrsfm.report.table import statistics_rows
from corrsfm.types import PairStatistics

__all__ = ["LoadMatches", "write_html"]

LoadMatches = Callable[[str, str], tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]]
"""Names of a pair → its putative matches: points in photo 0 and in photo 1, (M, 2) float32 pixels in COLMAP's
convention, and (M,) bool, the matches that pruning kept."""

_DRAWN_PAIRS = 3
_MOST_LINES = (150, 60)
_THUMBNAILS = 24
_THUMBNAIL_SIZE = 120
_LISTED_PAIRS = 300
_SHOWN_STEPS = 3


def write_html(
    report: SceneReport,
    path: Path,
    *,
    model: pycolmap.Reconstruction | None = None,
    images_dir: Path | None = None,
    load_matches: LoadMatches | None = None,
    load_verified: LoadVerified | None = None,
) -> None:
    """Write the page; it appears at ``path`` whole or not at all.

    Parameters
    ----------
    report : SceneReport
    path : Path
        The HTML file.
    model : pycolmap.Reconstruction, optional
        The first model, for the 3-D view and two histograms. Without plotly the view is a still picture.
    images_dir : Path, optional
        Folder of the photos, for drawn matches and thumbnails; missing photos are left out.
    load_matches : callable, optional
        Gives the matches to draw.
    load_verified : callable, optional
        Gives the verified matches of contradicted pairs.

    Raises
    ------
    WorkspaceError
        If the page cannot be written.
    """
    sections = [
        _verdict(report),
        _tiles(report),
        _missing(report, images_dir),
        section("What the run warned of", _warnings(report)),
        section("Model", _model_view(make_view(model))) if model is not None else "",
        section("What the model explains", explained_pairs(report, images_dir, load_verified)),
        section("Statistics", _statistics(report)),
        section("Distributions", _histograms(report, model)),
        section("View graph", _view_graph(report)),
        section("Matches", _matches(report, images_dir, load_matches)),
        section("Run", _run(report)),
    ]
    atomic_write_text(path, frame(report.scene, _subtitle(report), "\n".join(filter(None, sections))))


def _subtitle(report: SceneReport) -> str:
    sections = [section for section in report.configuration.values() if isinstance(section, dict)]
    method = next((section["method"] for section in sections if "method" in section), None)
    made_by = f"corrsfm {report.versions['corrsfm']}" if "corrsfm" in report.versions else "corrsfm"
    return html.escape(f"Reconstruction by {made_by}" + (f", matches pruned by {method}" if method else ""))


def _verdict(report: SceneReport) -> str:
    """The verdict on the first model, what to do about it and what it rests on, above everything else."""
    if not report.verdict:
        return ""
    if "verdict" not in report.evidence:
        return _no_model(report)
    verdict = report.evidence["verdict"]
    facts = []
    if (predicted := report.evidence.get("num_predicted_matches")) is not None:
        num = len(report.evidence["models_tried"])
        facts.append(f"{num} models were tried; this one predicts {predicted:,} matches")
    if left_out := report.evidence.get("folds", {}).get("left_out"):
        pairs = "1 pair" if len(left_out) == 1 else f"{len(left_out)} pairs"
        facts.append(f"{pairs} of look-alike places left out to unfold it")
    steps = _items(verdict["next_steps"])
    return (
        f'<div class="verdict {verdict["grade"]}"><h2>The model is {verdict["grade"]}</h2>'
        f"<ul>{_items(verdict['reasons'])}</ul>"
        + (f"<h3>What to try next</h3><ul>{steps}</ul>" if steps else "")
        + (f'<p class="note">{html.escape("; ".join(facts))}</p>' if facts else "")
        + "</div>"
    )


def _no_model(report: SceneReport) -> str:
    """In place of a verdict: what most photos lack, and what to do about it."""
    steps = list(dict.fromkeys(photo.next_step for photo in report.missing))[:_SHOWN_STEPS]
    return (
        f'<div class="verdict wrong"><h2>There is no model</h2>'
        f"<ul>{_items([report.why_no_model])}</ul>"
        f"<h3>What to try next</h3><ul>{_items(steps)}</ul></div>"
    )


def _items(texts: Sequence[str]) -> str:
    return "".join(f"<li>{html.escape(text)}</li>" for text in texts)


def _tiles(report: SceneReport) -> str:
    """The headline numbers."""
    tiles = [
        ("photos registered", f"{report.num_registered} / {len(report.image_names)}"),
        *([("photos in all models", f"{report.num_in_models}")] if len(report.models) > 1 else []),
        ("pairs verified", f"{report.num_verified_pairs:,} / {len(report.pairs):,}"),
    ]
    if report.models:
        model = report.models[0]
        tiles += [
            ("points", f"{model.num_points:,}"),
            ("median reprojection error", f"{model.median_error_px:.2f} px"),
        ]
    if report.stage_seconds:
        tiles.append(("seconds", f"{sum(report.stage_seconds.values()):,.0f}"))
    cells = "".join(f"<div><b>{value}</b><span>{label}</span></div>" for label, value in tiles)
    return f'<div class="tiles">{cells}</div>'


def _statistics(report: SceneReport) -> str:
    rows = "".join(
        f"<tr><th>{html.escape(label)}</th><td>{html.escape(value)}</td></tr>"
        for label, value in statistics_rows(report)
        if label not in ("scene", "verdict", "seconds")
    )
    table = f'<div class="scroll"><table class="facts">{rows}</table></div>'
    if len(report.models) < 2:
        return table
    models = "".join(
        f"<tr><td>sparse/{number}</td><td>{model.num_images:,}</td><td>{model.num_points:,}</td>"
        f"<td>{model.mean_track_length:.2f}</td><td>{model.median_error_px:.2f}</td></tr>"
        for number, model in enumerate(report.models)
    )
    return (
        f'{table}\n<div class="scroll"><table class="numbers"><tr><th>model</th><th>photos</th>'
        f"<th>points</th><th>track length</th><th>median error, px</th></tr>{models}</table></div>"
    )


def _missing(report: SceneReport, images_dir: Path | None) -> str:
    if not report.missing:
        return ""
    rows = "".join(
        _missing_row(image, images_dir if index < _THUMBNAILS else None)
        for index, image in enumerate(report.missing)
    )
    noun = "photo is" if len(report.missing) == 1 else "photos are"
    return section(
        f"{len(report.missing)} {noun} not registered",
        f'<div class="scroll tall"><table class="missing">{rows}</table></div>',
    )


def _missing_row(image: MissingPhoto, images_dir: Path | None) -> str:
    photo = pictures.read_photo(images_dir / image.name, _THUMBNAIL_SIZE) if images_dir else None
    thumbnail = f'<img src="{pictures.jpeg_uri(photo[0])}" alt="">' if photo is not None else ""
    return (
        f"<tr><td>{thumbnail}</td><td>{html.escape(image.name)}</td>"
        f"<td><b>{html.escape(image.reason)}</b><br>{html.escape(image.detail)}"
        f'<br><span class="next">{html.escape(image.next_step)}</span></td></tr>'
    )


def _warnings(report: SceneReport) -> str:
    if not report.warnings:
        return ""
    rows = "".join(
        f'<tr><th>{html.escape(warning.stage)}</th><td class="lines">{html.escape(warning.message)}</td></tr>'
        for warning in report.warnings
    )
    return f'<div class="scroll tall"><table class="facts">{rows}</table></div>'


def _model_view(view: ModelView) -> str:
    shown = f"{len(view.points):,} points and {len(view.names):,} cameras"
    try:
        drawn = f'<div class="model">{plotly_view(view)}</div>'
        note = f"{shown}. Drag to turn, scroll to zoom; point at a camera to read its photo's name."
    except DependencyError:
        picture = pictures.draw_views(view.points, view.colours, view.centres, (view.low, view.high))
        drawn = (
            f'<img class="wide" src="{pictures.png_uri(picture)}" alt="the model from above and the side">'
        )
        note = (
            f"{shown}, from above and from the side. For a view that can be turned, "
            "<code>pip install 'corrsfm[report]'</code> and make the report again."
        )
    return f'{drawn}\n<p class="note">{note}</p>'


def _histograms(report: SceneReport, model: pycolmap.Reconstruction | None) -> str:
    drawn = []
    if model is not None and model.num_points3D():
        lengths = np.array([point.track.length() for point in model.points3D.values()])
        longest = int(np.clip(lengths.max(), 4, 30))
        edges = np.arange(2, longest + 2, dtype=np.float64)
        drawn.append(charts.histogram(lengths, edges, "track length, photos a point", "points"))
        errors = observation_errors(model)
        # Bins of 0.05 px for good models, wider ones for others; the limits stay round numbers.
        step = 0.05 * max(1, np.ceil(np.percentile(errors, 99) / 1.5))
        edges = np.round(step * np.arange(31), 2)
        drawn.append(charts.histogram(errors, edges, "reprojection error, px", "observations"))
    ratios = [pair.num_verified / pair.num_kept for pair in report.pairs if pair.num_verified]
    if ratios:
        edges = np.linspace(0, 1, 21)
        drawn.append(charts.histogram(ratios, edges, "inlier ratio of verified pairs", "pairs"))
    if not drawn:
        return ""
    charts_of = '<div class="charts">' + "".join(f"<figure>{chart}</figure>" for chart in drawn) + "</div>"
    num_without = len(report.pairs) - len(ratios)
    if not num_without:
        return charts_of
    count = "1 pair has" if num_without == 1 else f"{num_without:,} pairs have"
    return f'{charts_of}<p class="note">{count} no verified match and no inlier ratio.</p>'


def _view_graph(report: SceneReport) -> str:
    if not report.pairs:
        return "<p>No pair of photos was matched.</p>"
    uri = pictures.png_uri(pictures.draw_view_graph(report.image_names, report.pairs))
    low, high = pictures.view_graph_scale(report.pairs)
    ramp = pictures.png_uri(pictures.shade(np.linspace(0, 1, 128)[None]))
    names = "".join(f"<li>{html.escape(name)}</li>" for name in report.image_names[:1000])
    label = f"verified matches of all pairs of {len(report.image_names)} photos"
    return (
        f'<div class="graph"><figure>{charts.matrix(uri, report.image_names, label)}</figure><div>'
        "<p>Rows and columns are photos in order of their names; each cell is a pair.</p>"
        f'<p class="legend">verified matches <span>{low:,}</span><img src="{ramp}" alt="pale to dark">'
        f"<span>{high:,}</span></p>"
        '<p class="legend"><i class="grey"></i> matched, not verified</p>'
        '<p class="legend"><i class="white"></i> not matched</p>'
        f"<details><summary>Numbers and names</summary><ol>{names}</ol></details></div></div>"
    )


def _matches(report: SceneReport, images_dir: Path | None, load_matches: LoadMatches | None) -> str:
    drawn = []
    if images_dir is not None and load_matches is not None:
        for kind, pair in _pairs_to_draw(report):
            figure = _drawn_pair(kind, pair, images_dir, load_matches)
            if figure:
                drawn.append(figure)
    legend = (
        f'<p class="legend"><i style="background:{pictures.KEPT_COLOUR}"></i> kept by pruning '
        f'<i style="background:{pictures.DROPPED_COLOUR}"></i> dropped; '
        f"at most {_MOST_LINES[0]} and {_MOST_LINES[1]} lines are drawn</p>"
    )
    listed = sorted(report.pairs, key=lambda pair: -pair.num_verified)[:_LISTED_PAIRS]
    if not listed:
        return ""
    rows = "".join(
        f"<tr><td>{html.escape(pair.name0)}</td><td>{html.escape(pair.name1)}</td>"
        f"<td>{pair.num_putative:,}</td><td>{pair.num_kept:,}</td><td>{pair.num_verified:,}</td></tr>"
        for pair in listed
    )
    head = "<tr><th>photo 0</th><th>photo 1</th><th>putative</th><th>kept</th><th>verified</th></tr>"
    count = f"All {len(report.pairs):,} pairs"
    if len(listed) < len(report.pairs):
        count = f"The best {len(listed):,} of {len(report.pairs):,} pairs; all are in report.json"
    return (
        (legend + f'<div class="pairs">{"".join(drawn)}</div>' if drawn else "")
        + f'\n<details><summary>{count}</summary><div class="scroll tall">'
        + f'<table class="numbers names">{head}{rows}</table></div></details>'
    )


def _pairs_to_draw(report: SceneReport) -> list[tuple[str, PairStatistics]]:
    """Three strong pairs of different photos, and the three weakest of the other verified ones."""
    ranked = sorted(
        (pair for pair in report.pairs if pair.num_verified > 0), key=lambda pair: -pair.num_verified
    )
    strong: list[PairStatistics] = []
    seen: set[str] = set()
    for pair in ranked:
        if len(strong) < _DRAWN_PAIRS and not seen & {pair.name0, pair.name1}:
            strong.append(pair)
            seen |= {pair.name0, pair.name1}
    weak = [pair for pair in ranked if pair not in strong][-_DRAWN_PAIRS:]
    return [("strong", pair) for pair in strong] + [("weak", pair) for pair in weak]


def _drawn_pair(kind: str, pair: PairStatistics, images_dir: Path, load_matches: LoadMatches) -> str:
    points0, points1, kept = load_matches(pair.name0, pair.name1)
    paths = (images_dir / pair.name0, images_dir / pair.name1)
    uri = pictures.matches_uri(paths, (points0, points1), kept, most=_MOST_LINES)
    if uri is None:
        return ""
    names = html.escape(f"{pair.name0} – {pair.name1}")
    return (
        f'<figure><img class="wide" src="{uri}" alt=""><figcaption>'
        f"<b>{kind}</b> {names}: {pair.num_putative:,} putative, "
        f"{pair.num_kept:,} kept, {pair.num_verified:,} verified</figcaption></figure>"
    )


def _run(report: SceneReport) -> str:
    seconds = list(report.stage_seconds.items())
    body = f'<figure class="bars">{charts.bars(seconds, "s")}</figure>' if seconds else ""
    facts = {"configuration": report.configuration, "versions": report.versions}
    if any(facts.values()):
        text = html.escape(json.dumps(facts, indent=2, ensure_ascii=False, default=str))
        body += f"<details><summary>Options and versions</summary><pre>{text}</pre></details>"
    return body
