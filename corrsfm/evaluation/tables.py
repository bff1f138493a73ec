"""Result files as Markdown tables.

`corrsfm compare` and `corrsfm evaluate` print them; the project's documents show them by `make tables`.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from corrsfm.errors import InputError

__all__ = [
    "Table",
    "build_table",
    "grades_text",
    "median_and_worst",
    "median_and_worst_of",
    "percent_of",
    "render_table",
]


@dataclass(frozen=True, kw_only=True)
class Table:
    """A result file as text.

    Attributes
    ----------
    header : list of str
        The heading of every column; the first names what the rows are.
    rows : list of list of str
        One cell for each column.
    caption : str
        What the numbers were measured on and with.
    """

    header: list[str]
    rows: list[list[str]]
    caption: str

    def markdown(self) -> str:
        """The table and its caption; all columns but the first are aligned to the right."""
        rule = ["---"] + ["--:"] * (len(self.header) - 1)
        lines = [f"| {' | '.join(cells)} |" for cells in (self.header, rule, *self.rows)]
        return "\n".join([*lines, "", self.caption])


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _range(interval: list[float] | None) -> str:
    return "" if interval is None else f" [{interval[1]:.1f}, {interval[2]:.1f}]"


def _difference(interval: list[float] | None) -> str:
    return "–" if interval is None else f"{interval[0]:+.1f} [{interval[1]:+.1f}, {interval[2]:+.1f}]"


def _pose_table(values: dict[str, Any]) -> Table:
    header = [
        "filter / estimator", "AUC@5 [95 %]", "AUC@10", "AUC@20", "AUC@5 − baseline", "mAP@5", "precision",
        "recall", "F", "kept", "filter ms", "estimator ms",
    ]  # fmt: skip
    rows = []
    for name, method in values["methods"].items():
        s = method["summary"]
        rows.append(
            [
                " / ".join(name.rsplit("/", 1)) + (" (baseline)" if name == values["baseline"] else ""),
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
        f"{subject['num_matches']:.0f} putative matches, {subject['inlier_percent']:.1f} % of them inliers. "
        f"{_origin(values)}"
    )
    return Table(header=header, rows=rows, caption=caption)


def _homography_table(values: dict[str, Any]) -> Table:
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
    return Table(header=header, rows=rows, caption=f"{count} sequences. {_origin(values)}")


def median_and_worst(method: dict[str, Any], value: Callable[[dict[str, Any]], float], spec: str) -> str:
    """A number of a method as "median (worst)" over its seeds, each formatted as ``spec`` says."""
    return f"{value(method['median']):{spec}} ({value(method['worst']):{spec}})"


def grades_text(seeds: Sequence[dict[str, Any]]) -> str:
    """The verdicts on the models of some seeds, such as "3 good, 2 doubtful"; a dash if there are none."""
    # Old result files have tables without it, and it is slow to import.
    from corrsfm.reconstruction.verdict import Grade

    grades = Counter("failed" if seed["failure"] else seed["grade"] for seed in seeds)
    return ", ".join(f"{grades[grade]} {grade}" for grade in (*Grade, "failed") if grades[grade]) or "–"


def _compare_table(values: dict[str, Any]) -> Table:
    methods = values["methods"]
    num_seeds = min(len(method.get("seeds", [])) for method in methods.values())
    if num_seeds > 1:
        return _compare_seeds_table(values, num_seeds)
    truth = any(method.get("ground_truth") for method in methods.values())
    header = [
        "method", "verified pairs", "inlier ratio", "photos", "points", "track length", "error px",
        "prune s", "map s",
    ]  # fmt: skip
    header += ["AUC@1", "AUC@5", "AUC@10", "position error %"] if truth else []
    header += ["explained %", "predicted", "verdict"] if num_seeds else []
    rows = []
    for name, m in methods.items():
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
        if num_seeds:
            row += _seed_cells(m["seeds"][0])[-3:]
        rows.append(row)
    return Table(header=header, rows=rows, caption=_origin(values))


def _compare_seeds_table(values: dict[str, Any], num_seeds: int) -> Table:
    """Median and worst of each method; narrow enough for a terminal, the page has the rest."""
    methods = values["methods"]
    truth = all("auc" in method["median"] for method in methods.values())
    header = ["method", "photos", "points", "explained %", "predicted"]
    header += ["AUC@5", "verdicts"] if truth else ["verdicts"]
    rows = []
    for name, method in methods.items():
        row = [
            name,
            median_and_worst(method, lambda m: m["num_registered"], ".0f"),
            median_and_worst(method, lambda m: m["num_points"], ".0f"),
            median_and_worst(method, lambda m: 100.0 * m["explained_share"], ".0f"),
            median_and_worst(method, lambda m: m["num_predicted_matches"], ".0f"),
        ]
        row += [median_and_worst(method, lambda m: m["auc"]["5"], ".1f")] if truth else []
        rows.append([*row, grades_text(method["seeds"])])
    caption = (
        f"Median (worst) of {num_seeds} seeds from {values['provenance']['seed']} on, "
        f"{values['subject']['num_photos']} photos. {_libraries(values)}."
    )
    return Table(header=header, rows=rows, caption=caption)


# Known cameras that predict fewer matches than this share of a model's are doubted. They were not fitted to
# these matches, so a little less is to be expected.
_AS_MANY = 0.9


def median_and_worst_of(numbers: Iterable[float]) -> str:
    """Numbers of several runs, of which more is better, as "median (worst)"."""
    numbers = list(numbers)
    return f"{statistics.median(numbers):.1f} ({min(numbers):.1f})"


def percent_of(share: float) -> float:
    """A share in percent, rounded down to a tenth as in verdicts: 99.97 % is not everything."""
    return math.floor(1000.0 * share) / 10.0


def _seed_cells(seed: dict[str, Any]) -> list[str]:
    """Photos, points, explained share, predicted matches and verdict on one model."""
    return [
        str(seed["num_registered"]),
        str(seed["num_points"]),
        _number(percent_of(seed["explained_share"])),
        str(seed["num_predicted_matches"]),
        grades_text([seed]).removeprefix("1 "),
    ]


def _scene_table(values: dict[str, Any]) -> Table:
    """Every seed of one scene, then the median and the worst."""
    rows = []
    for seed in values["seeds"]:
        photos, points, explained, predicted, grade = _seed_cells(seed)
        auc = [_number(value) for value in seed["ground_truth"]["auc"].values()]
        rows.append([str(seed["seed"]), photos, points, explained, predicted, *auc, grade])
    for name in ("median", "worst"):
        summary = values[name]
        row = [
            name,
            _number(summary["num_registered"], 0),
            _number(summary["num_points"], 0),
            _number(percent_of(summary["explained_share"])),
            _number(summary["num_predicted_matches"], 0),
            *(_number(value) for value in summary["auc"].values()),
        ]
        rows.append([*row, grades_text(values["seeds"]) if name == "median" else ""])
    caption = f"The workspace's own model is that of seed {values['seeds'][0]['seed']}."
    if known := values.get("known_cameras"):
        explained, predicted = known["explained_share"], known["num_predicted_matches"]
        cells = [str(known["num_photos"]), "", _number(percent_of(explained)), str(predicted)]
        rows.append(["known cameras", *cells, *("" for _ in values["median"]["auc"]), ""])
        median = values["median"]
        fewer = predicted < _AS_MANY * median["num_predicted_matches"]
        if fewer and explained < median["explained_share"]:
            caption += " The known cameras explain and predict less than these models: perhaps they are off."
    header = ["seed", "photos", "points", "explained %", "predicted"]
    header += [f"AUC@{threshold}" for threshold in values["median"]["auc"]]
    return Table(header=[*header, "verdict"], rows=rows, caption=caption)


_PYCOLMAP_STAGES = {
    "extract": "features",
    "match": "matches",
    "prune": "pruned matches",
    "verify": "verified matches",
    "map": "models",
}


def _pycolmap_table(values: dict[str, Any]) -> Table:
    """Rows of the runs on one core, beside the seconds of those on all; and their sums by method."""
    rows, single = [], [row for row in values["rows"] if row["cores"] == 1]
    most = max(row["cores"] for row in values["rows"])
    parallel = {(row["scene"], row["method"]): row for row in values["rows"] if row["cores"] == most}
    totals: dict[str, list[float]] = {}
    for row in single:
        beside = parallel[row["scene"], row["method"]]
        stages = [row["stage_seconds"].get(stage, 0.0) for stage in _PYCOLMAP_STAGES.values()]
        numbers = [*stages, row["seconds"], row["processor_seconds"], beside["seconds"]]
        sums = totals.setdefault(row["method"], [0.0] * len(numbers))
        totals[row["method"]] = [total + number for total, number in zip(sums, numbers, strict=True)]
        facts = [row["scene"], str(row["photos"]), row["method"], str(row["registered"]), str(row["points"])]
        error = _number(row["median_error_px"], 2)
        rows.append([*facts, error, *(_number(number) if number else "–" for number in numbers)])
    for method, numbers in totals.items():
        blank = ["", "", ""]
        rows.append(["all", "", method, *blank, *(_number(number) if number else "–" for number in numbers)])
    header = [
        *("scene", "photos", "method", "registered", "points", "median error px"),
        *(f"{stage} s" for stage in _PYCOLMAP_STAGES),
        *("one core s", "CPU s", f"{most} cores s"),
    ]
    caption = (
        f"Up to {values['subject']['max_features']} features a photo, exhaustive pairs. Stages on one core; "
        f"pycolmap verifies as it matches. {_origin(values)}"
    )
    return Table(header=header, rows=rows, caption=caption)


def _whole_scenes_table(values: dict[str, Any]) -> Table:
    """Scenes by columns; of a column's settings the one with the best median, and which that is.

    More columns than scenes, each of one setting, go down the page instead.
    """
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in values["rows"]:
        found.setdefault(row["scene"], {}).setdefault(row["column"], []).append(row)
    columns = list(dict.fromkeys(row["column"] for row in values["rows"]))
    settings = {(row["column"], row["setting"]) for row in values["rows"]}
    is_choice = {column: sum(one == column for one, _ in settings) > 1 for column in columns}
    num_seeds = max(len(row["runs"]) for row in values["rows"])
    caption = f"AUC@5 of {num_seeds} seeds: median (worst). {_origin(values)}"
    if len(columns) > len(found) and not any(is_choice.values()):
        cells_of = {
            scene: {column: _runs_cell(rows[0]["runs"], num_seeds) for column, rows in by_column.items()}
            for scene, by_column in found.items()
        }
        return Table(
            header=["matches kept by", *found],
            rows=[[name, *(cells_of[scene].get(name, "–") for scene in found)] for name in columns],
            caption=caption,
        )
    header = ["scene", "photos"]
    for column in columns:
        header += [column, "which"] if is_choice[column] else [column]
    rows = []
    for scene, by_column in found.items():
        cells = [scene, str(next(iter(by_column.values()))[0]["runs"][0]["num_photos"])]
        for column in columns:
            choice = by_column.get(column, [])
            best = max(choice, key=lambda row: _median_score(row["runs"]), default=None)
            cells.append(_runs_cell(best["runs"], num_seeds) if best else "–")
            if is_choice[column]:
                cells.append(f"{best['setting']} (of {len(choice)})" if best else "–")
        rows.append(cells)
    return Table(header=header, rows=rows, caption=caption)


def _median_score(runs: list[dict[str, Any]]) -> float:
    return statistics.median(run["auc5"] for run in runs)


def _runs_cell(runs: list[dict[str, Any]], num_seeds: int) -> str:
    """Median and worst score, and the photos and runs if some are missing."""
    text = median_and_worst_of(run["auc5"] for run in runs)
    registered, photos = min(run["num_registered"] for run in runs), runs[0]["num_photos"]
    if registered < photos:
        text += f", {registered}/{photos}"
    return text if len(runs) == num_seeds else f"{text}, {len(runs)} of {num_seeds} seeds"


def _bench_table(values: dict[str, Any]) -> Table:
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
    return Table(header=header, rows=rows, caption=caption)


def _origin(values: dict[str, Any]) -> str:
    """Origin of a table for its caption: versions and seed."""
    return f"{_libraries(values)}; seed {values['provenance']['seed']}."


def _libraries(values: dict[str, Any]) -> str:
    versions = values["provenance"]["versions"]
    return ", ".join(
        f"{name} {versions[key]}"
        for name, key in (
            ("corrsfm", "corrsfm"),
            ("OpenCV", "opencv-python-headless"),
            ("pycolmap", "pycolmap"),
            ("PoseLib", "poselib"),
        )
        if key in versions
    )


_RENDERERS: dict[str, Callable[[dict[str, Any]], Table]] = {
    "pose": _pose_table,
    "homography": _homography_table,
    "compare": _compare_table,
    "scene": _scene_table,
    "pycolmap": _pycolmap_table,
    "bench": _bench_table,
    "whole_scenes": _whole_scenes_table,
}


def build_table(values: dict[str, Any]) -> Table:
    """The table of a result file's content.

    Raises
    ------
    InputError
        If there is none for its kind.
    """
    if values["kind"] not in _RENDERERS:
        raise InputError(f"no table for results of kind {values['kind']}; there are {', '.join(_RENDERERS)}")
    return _RENDERERS[values["kind"]](values)


def render_table(values: dict[str, Any]) -> str:
    """Render the content of a result file as a Markdown table with its caption.

    Raises
    ------
    InputError
        If no table is known for its kind.
    """
    return build_table(values).markdown()
