"""Drawings of the page as SVG: histograms, bars, and axes around the view-graph picture."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["MOST_NAMES", "bars", "histogram", "matrix"]

_WIDTH, _HEIGHT = 340, 210
_BARS_WIDTH = 460
# Of a matrix: names beside the rows, and their characters.
MOST_NAMES, _LONGEST_NAME = 40, 18
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 10, 12, 40


def histogram(values: ArrayLike, edges: NDArray[np.float64], label: str, unit: str) -> str:
    """A histogram.

    Parameters
    ----------
    values : array_like
        Values beyond the last edge are counted in the last bin, whose label then reads "≥".
    edges : (B + 1,) float64
        Limits of the bins.
    label : str
        What the horizontal axis shows.
    unit : str
        What is counted.
    """
    values = np.asarray(values, np.float64)
    beyond = bool(np.any(values > edges[-1]))
    counts, _ = np.histogram(np.minimum(values, edges[-1]), edges)
    top = 2 * _nice(math.ceil(int(counts.max(initial=1)) / 2))
    width = (_WIDTH - _LEFT - _RIGHT) / len(counts)
    height = _HEIGHT - _TOP - _BOTTOM
    parts = []
    for part in (0, 0.5, 1):
        y = _TOP + height * (1 - part)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(_text(_LEFT - 5, y + 4, f"{top * part:,.0f}", "end"))
    for index, count in enumerate(counts):
        bar = height * count / top
        limits = f"{edges[index]:g} to {edges[index + 1]:g}"
        if beyond and index == len(counts) - 1:
            limits = f"{edges[index]:g} or more"
        parts.append(
            f'<rect class="bar" x="{_LEFT + index * width + 0.5:.2f}" y="{_TOP + height - bar:.2f}" '
            f'width="{max(width - 1, 0.5):.2f}" height="{bar:.2f}"><title>{limits}: {count:,}</title></rect>'
        )
    every = _nice(math.ceil(len(edges) / 7))
    for index in range(0, len(edges), every):
        x = _LEFT + index * width
        mark = "≥ " if beyond and index == len(edges) - 1 else ""
        parts.append(_text(x, _TOP + height + 14, f"{mark}{edges[index]:g}", "middle"))
    parts.append(_text((_LEFT + _WIDTH - _RIGHT) / 2, _HEIGHT - 8, label, "middle", "axis"))
    title = f"{len(values):,} {unit}"
    return _svg(_WIDTH, _HEIGHT, f"histogram of {label}, {title}", parts)


def bars(rows: Sequence[tuple[str, float]], unit: str) -> str:
    """Horizontal bars with their values, one row each."""
    row_height, label_width, value_width = 26, 120, 64
    height = row_height * len(rows) + 4
    longest = max([value for _, value in rows], default=0.0) or 1.0
    room = _BARS_WIDTH - label_width - value_width
    parts = []
    for index, (label, value) in enumerate(rows):
        y = index * row_height + 4
        length = room * value / longest
        parts.append(_text(label_width - 8, y + 14, label, "end"))
        parts.append(
            f'<rect class="bar" x="{label_width}" y="{y + 2}" width="{length:.1f}" height="16" rx="2"/>'
        )
        parts.append(_text(label_width + length + 6, y + 14, f"{value:,.1f} {unit}", "start"))
    return _svg(_BARS_WIDTH, height, f"{unit} for each of {', '.join(label for label, _ in rows)}", parts)


def matrix(
    picture_uri: str,
    names: Sequence[str],
    label: str,
    *,
    numbers: Sequence[int] | None = None,
    marks: Sequence[tuple[int, int]] = (),
) -> str:
    """A square picture of photos by photos, with their numbers along two sides, and names if they fit.

    Parameters
    ----------
    picture_uri : str
        One row and one column a photo, or fewer.
    names : sequence of str
    label : str
        What it shows, for those who do not see it.
    numbers : sequence of int, optional
        Of the photos; 1, 2, … by default.
    marks : sequence of (row, column)
        Cells to cross out.
    """
    numbers = numbers or range(1, len(names) + 1)
    side, top = 500, 34
    shown = [_short(name) for name in names] if len(names) <= MOST_NAMES else []
    left = 34 + (12 + 6 * max(map(len, shown)) if shown else 0)
    cell = side / max(len(names), 1)
    parts = [
        f'<image href="{picture_uri}" x="{left}" y="{top}" width="{side}" height="{side}" '
        'preserveAspectRatio="none" style="image-rendering:pixelated"/>',
        f'<rect class="frame" x="{left}" y="{top}" width="{side}" height="{side}"/>',
    ]
    step = _nice(math.ceil(len(names) / 15))
    for index in range(0, len(names), step):
        parts.append(_text(left + cell * (index + 0.5), top - 8, str(numbers[index]), "middle"))
    for index in range(0, len(names), 1 if shown else step):
        row = f"{shown[index]}  {numbers[index]}" if shown else str(numbers[index])
        parts.append(_text(left - 6, top + cell * (index + 0.5) + 4, row, "end"))
    if marks:
        # In a large matrix the cross is larger than its cell, so that it is seen.
        arm = max(0.22 * cell, 1.8)
        path = "".join(
            f"M{left + cell * (column + 0.5) - arm:.1f} {top + cell * (row + 0.5) - arm:.1f}"
            f"l{2 * arm:.1f} {2 * arm:.1f}m0 {-2 * arm:.1f}l{-2 * arm:.1f} {2 * arm:.1f}"
            for row, column in marks
        )
        parts.append(f'<path class="mark" stroke-width="{min(max(0.07 * cell, 0.6), 3):.1f}" d="{path}"/>')
    return _svg(left + side + 2, top + side + 2, label, parts)


def _short(name: str) -> str:
    """The end of a long name: there names of one folder differ."""
    return name if len(name) <= _LONGEST_NAME else f"…{name[1 - _LONGEST_NAME :]}"


def _text(x: float, y: float, text: str, anchor: str, kind: str = "tick") -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{html.escape(text)}</text>'


def _svg(width: float, height: float, label: str, parts: Sequence[str]) -> str:
    body = "".join(parts)
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{html.escape(label, quote=True)}">'
        f"{body}</svg>"
    )


def _nice(least: int) -> int:
    """The smallest of 1, 1.5, 2, 3 … 9 times a power of ten that is not below a number."""
    power = 1
    while True:
        for factor in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8):
            candidate = factor * power
            if candidate >= least and candidate == int(candidate):
                return int(candidate)
        power *= 10
