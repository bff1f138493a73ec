"""Tables and a picture of what the project measures of itself: growth, reliability, costs, folds.

`tools/growth.py` and `tests/reliability/run.py` measure and keep their rows by `keep_row`,
`tools/rivals_cost.py` and `tools/folds.py` write their files themselves; `tools/tables.py` shows them.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from corrsfm.evaluation.records import load_results, provenance, save_results
from corrsfm.evaluation.tables import Table, median_and_worst_of

__all__ = ["HOUSE_TABLES", "draw_growth", "keep_row"]

FIRST, AGAIN, MORE = "first run", "nothing to do", "one more pair"
_OF_PAIRS = ("matches", "kept matches", "database")
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 380, 300, 52, 96, 30, 44
_COLOURS = ("#26547c", "#c9740a", "#5f8f3e")


def keep_row(path: Path, kind: str, name: str, row: Mapping[str, Any], *, command: str) -> None:
    """Put a named row into a result file, in place of an older one of its name.

    Parameters
    ----------
    path : Path
    kind : str
        Of the file.
    name : str
    row : mapping
    command : str
        That measures the row; the file names that of its first row.
    """
    rows = load_results(path, kind)["rows"] if path.exists() else {}
    rows[name] = {**row, "provenance": provenance(seed=int(row.get("seed", 0)), command=command)}
    first = next(iter(rows.values()))["provenance"]["command"]
    save_results(path, kind, {"provenance": provenance(seed=0, command=first), "rows": rows})


def _growth_table(values: dict[str, Any]) -> Table:
    header = ["photos", "pairs", *(f"{kind}, s" for kind in (FIRST, AGAIN, MORE)), "of it the pair's, s"]
    header += ["memory, GiB", "disk, GB"]
    rows = [
        [
            f"{row['num_photos']:,}",
            f"{row['num_pairs']:,}",
            *(f"{_total(row, kind):,.0f}" for kind in (FIRST, AGAIN, MORE)),
            f"{sum(row[MORE][step]['seconds'] for step in _OF_PAIRS):,.1f}",
            f"{_largest(row):.2f}",
            f"{sum(row['bytes'].values()) / 1e9:.2f}",
        ]
        for row in _by_size(values)
    ]
    return Table(header=header, rows=rows, caption=_machine(values))


def _reliability_table(values: dict[str, Any]) -> Table:
    header = ["tried", "number", "faults", "what counts as a fault"]
    rows = [
        [name, f"{row['number']:,}", f"{row['faults']:,}", row["counted"]]
        for name, row in values["rows"].items()
    ]
    return Table(header=header, rows=rows, caption=_machine(values))


def _costs_table(values: dict[str, Any]) -> Table:
    header = ["network", "matches read", "parameters", "GFLOP a pair", "ms a pair"]
    rows = [
        [
            name,
            f"{row['num_matches']:,}",
            f"{row['parameters']:,}",
            f"{row['gflop']:.2f}",
            f"{row['ms']:,.0f}",
        ]
        for name, row in values["rows"].items()
    ]
    machine = values["provenance"]["machine"]["processor"]
    return Table(header=header, rows=rows, caption=f"One core of {machine}.")


def _folds_table(values: dict[str, Any]) -> Table:
    """Scenes of which a model was unfolded, mended or called folded; the caption counts the others."""
    header = [
        *("scene", "photos", "unfolded", "mended", "called folded"),
        *("photos in place", "AUC@5 with --no-unfold", "AUC@5"),
    ]
    rows, quiet = [], []
    for scene, runs in values["rows"].items():
        unfolded = sum(run["unfolded_by"] is not None for run in runs)
        mended = sum("+mended" in (run.get("chosen") or "") for run in runs)
        folded = sum(bool(run["still_folded"]) for run in runs)
        if not unfolded and not mended and not folded:
            quiet.append(runs)
            continue
        rows.append(
            [
                scene,
                str(runs[0]["num_photos"]),
                *(f"{number} of {len(runs)}" for number in (unfolded, mended, folded)),
                str(min(run["num_in_place"] for run in runs)) if "num_in_place" in runs[0] else "–",
                *(
                    median_and_worst_of(auc)
                    for auc in (map(_auc_without, runs), (run["auc5"] for run in runs))
                ),
            ]
        )
    caption = (
        "AUC@5: median (worst); photos in place: the fewest of the runs. "
        f"On {len(quiet)} other scenes, in {sum(map(len, quiet))} runs, nothing was unfolded, mended or "
        "called folded."
    )
    return Table(header=header, rows=rows, caption=caption)


def _auc_without(run: dict[str, Any]) -> float:
    return float(run.get("without", run)["auc5"])


def _machine(values: dict[str, Any]) -> str:
    machine = values["provenance"]["machine"]
    return f"{machine['cores']} cores of {machine['processor']}."


def _by_size(values: dict[str, Any]) -> list[dict[str, Any]]:
    return sorted(values["rows"].values(), key=lambda row: row["num_photos"])


def _values(row: Mapping[str, Any], kind: str, what: str) -> list[float]:
    return [step[what] for step in row[kind].values()]


def _total(row: Mapping[str, Any], kind: str) -> float:
    return sum(_values(row, kind, "seconds"))


def _largest(row: Mapping[str, Any]) -> float:
    """Memory of the step that takes most."""
    return max(peak for kind in (FIRST, AGAIN, MORE) for peak in _values(row, kind, "peak_gib"))


def draw_growth(values: dict[str, Any]) -> str:
    """Seconds and memory over the number of photos, both axes logarithmic, as an SVG file."""
    rows = _by_size(values)
    photos = [row["num_photos"] for row in rows]
    seconds = {kind: [max(_total(row, kind), 0.1) for row in rows] for kind in (FIRST, AGAIN, MORE)}
    memory = {"largest step": [_largest(row) for row in rows]}
    panels = [_panel("seconds of all steps", photos, seconds), _panel("memory, GiB", photos, memory)]
    body = "".join(
        f'<g transform="translate({number * _WIDTH} 0)">{panel}</g>' for number, panel in enumerate(panels)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {2 * _WIDTH} {_HEIGHT}" '
        'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="white"/>'
        f"{body}</svg>\n"
    )


def _panel(title: str, photos: Sequence[int], lines: Mapping[str, Sequence[float]]) -> str:
    everything = [value for line in lines.values() for value in line]
    low, high = math.floor(math.log10(min(everything))), math.ceil(math.log10(max(everything)))
    first, last = math.log10(min(photos)), math.log10(max(photos))
    width, height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM

    def x(value: float) -> float:
        return _LEFT + width * (math.log10(value) - first) / max(last - first, 1e-9)

    def y(value: float) -> float:
        return _TOP + height * (high - math.log10(value)) / max(high - low, 1)

    parts = [_text(_LEFT, 18, title, "start", bold=True)]
    for power in range(low, high + 1):
        level = y(10.0**power)
        parts.append(
            f'<line x1="{_LEFT}" x2="{_LEFT + width}" y1="{level:.1f}" y2="{level:.1f}" stroke="#ddd"/>'
        )
        parts.append(_text(_LEFT - 6, level + 4, f"{10.0**power:g}", "end"))
    for number in photos:
        parts.append(_text(x(number), _TOP + height + 18, f"{number:,}", "middle"))
    parts.append(_text(_LEFT + width / 2, _HEIGHT - 8, "photos, with twenty pairs each", "middle"))
    labels: list[float] = []
    # From the top, so that each label goes below those that it would cover.
    ordered = sorted(zip(_COLOURS, lines.items(), strict=False), key=lambda line: -line[1][1][-1])
    for colour, (name, values) in ordered:
        points = [(x(number), y(value)) for number, value in zip(photos, values, strict=True)]
        line = " ".join(f"{left:.1f},{top:.1f}" for left, top in points)
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2"/>')
        parts += [f'<circle cx="{left:.1f}" cy="{top:.1f}" r="3" fill="{colour}"/>' for left, top in points]
        labels.append(max(y(values[-1]) + 4, labels[-1] + 14 if labels else 0.0))
        parts.append(_text(x(photos[-1]) + 8, labels[-1], name, "start", colour))
    return "".join(parts)


def _text(x: float, y: float, text: str, anchor: str, colour: str = "#333", *, bold: bool = False) -> str:
    style = f'text-anchor="{anchor}" fill="{colour}"' + (' font-weight="bold"' if bold else "")
    return f'<text x="{x:.1f}" y="{y:.1f}" {style}>{html.escape(text)}</text>'


HOUSE_TABLES: dict[str, Callable[[dict[str, Any]], Table]] = {
    "costs": _costs_table,
    "folds": _folds_table,
    "growth": _growth_table,
    "reliability": _reliability_table,
}
