"""The HTML page of a comparison: its table, and drawings of the pairs that methods differ most on."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from corrsfm.evaluation.tables import grades_text, median_and_worst, percent_of
from corrsfm.files import atomic_write_text
from corrsfm.report.pictures import draw_matches, jpeg_uri, read_photo
from corrsfm.report.style import frame, section
from corrsfm.types import Pair
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import read_pairs
from corrsfm.workspace.stores import features_of, matches_of, pruned_of

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
_ONE_SEED_COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], Any], int, int], ...] = (
    ("explained %", lambda m: percent_of(m["seeds"][0]["explained_share"]), 1, 1),
    ("predicted", lambda m: m["seeds"][0]["num_predicted_matches"], 0, 1),
)
_TRUTH_COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], Any], int, int], ...] = (
    ("AUC@1°", lambda m: m["ground_truth"]["auc"]["1"], 1, 1),
    ("AUC@5°", lambda m: m["ground_truth"]["auc"]["5"], 1, 1),
    ("AUC@10°", lambda m: m["ground_truth"]["auc"]["10"], 1, 1),
    ("position error %", lambda m: m["ground_truth"]["position_error_percent"], 2, -1),
)
_SEED_COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], Any], str], ...] = (
    # heading, value of one seed, a median or a worst, and its format; more is better
    ("photos", lambda s: s["num_registered"], ",g"),
    ("points", lambda s: s["num_points"], ",.0f"),
    ("explained %", lambda s: percent_of(s["explained_share"]), ".1f"),
    ("predicted", lambda s: s["num_predicted_matches"], ",.0f"),
)
_SEED_TRUTH_COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], Any], str], ...] = (
    ("AUC@1°", lambda s: _auc_of(s)["1"], ".1f"),
    ("AUC@5°", lambda s: _auc_of(s)["5"], ".1f"),
    ("AUC@10°", lambda s: _auc_of(s)["10"], ".1f"),
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
    num_seeds = len(next(iter(values["methods"].values()))["seeds"])
    if num_seeds > 1:
        tables = [
            section(f"Median (worst) of {num_seeds} seeds", _seeds(values["methods"])),
            section(f"Seed {provenance['seed']} in detail", _table(values["methods"])),
        ]
    else:
        tables = [section("Methods", _table(values["methods"]))]
    legend = (
        "<p class='note'>By number of verified matches. <span class='kept'>Blue: kept</span>, "
        "<span class='dropped'>orange: dropped</span>; at most 150 and 60 are drawn.</p>"
    )
    drawn = _drawn_pairs(values["pairs"][:_NUM_DRAWN_PAIRS], base, workspaces)
    origin = f"{escape(versions)}; seed {provenance['seed']}. {escape(provenance['command'])}"
    body = [
        *tables,
        section("Pairs that differ most", legend + "\n".join(drawn)),
        f"<p class='note'>{origin}</p>",
    ]
    title = f"{subject['name']}: prune methods compared"
    atomic_write_text(path, frame(title, subtitle, "\n".join(body)))


def _seeds(methods: dict[str, Any]) -> str:
    """The median and the worst of each method, and every model."""
    columns = [*_SEED_COLUMNS]
    if all("auc" in method["median"] for method in methods.values()):
        columns += _SEED_TRUTH_COLUMNS
    best = [_best([value(method["median"]) for method in methods.values()], 1) for _, value, _ in columns]
    medians, models = [], []
    for name, method in methods.items():
        cells = [
            _cell(
                median_and_worst(method, value, spec).replace(" ", "\N{NO-BREAK SPACE}"),
                best=value(method["median"]) == winner,
            )
            for (_, value, spec), winner in zip(columns, best, strict=True)
        ]
        medians.append(_row(_cell(_short(name)), *cells, _cell(grades_text(method["seeds"]))))
        models += [_model(name, seed, columns) for seed in method["seeds"]]
    headings = [heading for heading, *_ in columns]
    note = (
        "<p class='note'>Mapping depends on the seed. Explained: verified matches that agree with the model. "
        "Predicted: matches along the epipolar lines that its poses draw, in the same pairs of photos for "
        "all models. A seed without a model counts as no photo and an AUC of 0.</p>"
    )
    every = _numbers(["method", "seed", *headings, "contradicted pairs", "map s", "verdict"], models)
    return (
        f"{note}{_numbers(['method', *headings, 'verdicts'], medians)}"
        f"<details><summary>every model</summary>{every}</details>"
    )


def _model(
    method: str, seed: dict[str, Any], columns: Sequence[tuple[str, Callable[[dict[str, Any]], Any], str]]
) -> str:
    cells = [_cell(f"{value(seed):{spec}}") for _, value, spec in columns]
    cells += [_cell(str(seed["num_contradicted_pairs"])), _cell(_number(seed["seconds"]["map"], 1))]
    verdict = grades_text([seed]).removeprefix("1 ")
    row = _row(_cell(_short(method)), _cell(str(seed["seed"])), *cells, _cell(verdict))
    return row + _failure(seed["failure"], 3 + len(cells))


def _auc_of(values: dict[str, Any]) -> dict[str, float]:
    """AUC by threshold of a summary over seeds, or of one seed."""
    return values["auc"] if "auc" in values else values["ground_truth"]["auc"]


def _short(method: str) -> str:
    """A method without the folders that its checkpoint lies in, but for the last, which may tell it."""
    name, colon, checkpoint = method.partition(":")
    return name + colon + "/".join(Path(checkpoint).parts[-2:])


def _table(methods: dict[str, Any]) -> str:
    columns = [*_COLUMNS]
    if all(len(method["seeds"]) == 1 for method in methods.values()):
        columns += _ONE_SEED_COLUMNS
    if all(method["ground_truth"] for method in methods.values()):
        columns += _TRUTH_COLUMNS
    # A method that gave no model is not the best at anything.
    mapped = [method for method in methods.values() if not method["failure"]]
    best = [_best([value(method) for method in mapped], sense) for _, value, _, sense in columns]
    rows = []
    for name, method in methods.items():
        may_win = not method["failure"]
        cells = [
            _cell(
                _number(value(method), decimals),
                best=may_win and winner is not None and value(method) == winner,
            )
            for (_, value, decimals, _), winner in zip(columns, best, strict=True)
        ]
        rows.append(_row(_cell(_short(name)), *cells))
        rows.append(_failure(method["failure"], len(columns) + 1))
    return _numbers(["method", *(heading for heading, *_ in columns)], rows)


def _failure(reason: str | None, num_columns: int) -> str:
    """A row with the reason why mapping failed; nothing if it did not."""
    if not reason:
        return ""
    return _row(f"<td class='failure' colspan='{num_columns}'>{escape(reason)}</td>")


def _number(number: float | None, decimals: int) -> str:
    return "–" if number is None else f"{number:,.{decimals}f}"


def _cell(text: str, *, best: bool = False) -> str:
    kind = " class='best'" if best else ""
    return f"<td{kind}>{escape(text)}</td>"


def _row(*cells: str) -> str:
    return f"<tr>{''.join(cells)}</tr>"


def _numbers(headings: Sequence[str], rows: Sequence[str]) -> str:
    """A table of numbers that scrolls where the page is narrow."""
    head = _row(*(f"<th>{escape(heading)}</th>" for heading in headings))
    return f"<div class='scroll'><table class='numbers'>{head}{''.join(rows)}</table></div>"


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
    features, putative = features_of(base), matches_of(base)
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
                f"<figcaption>{escape(_short(method))}: {len(indices)} → {kept} kept → {verified} verified"
                "</figcaption></figure>"
            )
        sections.append(
            f"<h3>{escape(pair[0])} – {escape(pair[1])}</h3><div class='pairs'>{''.join(figures)}</div>"
        )
    return sections


def _kept_mask(workspace: Workspace, pair: Pair, indices: NDArray[np.int32]) -> NDArray[np.bool_]:
    # Column 0 of putative matches strictly increases, so it identifies a match.
    return np.isin(indices[:, 0], pruned_of(workspace).read(pair).indices[:, 0])
