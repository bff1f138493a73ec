"""The statistics of a scene as text for a terminal."""

from __future__ import annotations

from corrsfm.report.statistics import SceneReport

__all__ = ["format_table", "statistics_rows"]

_MAX_MISSING = 20


def format_table(report: SceneReport) -> str:
    """Aligned lines ``what  value``, then the photos that are missing and why.

    Parameters
    ----------
    report : SceneReport

    Returns
    -------
    str
        Without a final line break.
    """
    rows = statistics_rows(report)
    width = max(len(label) for label, _ in rows)
    lines = [f"{label:<{width}}  {value}" for label, value in rows]
    if report.missing:
        lines += ["", "not registered"]
        shown = report.missing[:_MAX_MISSING]
        name_width = max(len(image.name) for image in shown)
        reason_width = max(len(image.reason) for image in shown)
        for image in shown:
            lines += [
                f"  {image.name:<{name_width}}  {image.reason:<{reason_width}}  {image.detail}",
                f"  {'':<{name_width}}  next: {image.next_step}",
            ]
        if len(report.missing) > len(shown):
            lines.append(f"  … and {len(report.missing) - len(shown)} more, see report.json")
    return "\n".join(lines)


def statistics_rows(report: SceneReport) -> list[tuple[str, str]]:
    """The statistics as pairs of label and value, in the order they are read."""
    rows = [
        ("scene", report.scene),
        *([("verdict", report.verdict)] if report.verdict else []),
        (
            "photos",
            f"{report.num_registered:,} of {len(report.image_names):,} registered "
            f"({report.registered_percent:.1f} %){_in_models(report)}",
        ),
        ("models", _models(report)),
        *(("cameras" if not number else "", text) for number, text in enumerate(report.camera_remarks)),
    ]
    if report.models:
        model = report.models[0]
        rows += [
            ("points", f"{model.num_points:,}"),
            ("observations", f"{model.num_observations:,}, {model.mean_observations_per_image:.1f} a photo"),
            ("track length", f"{model.mean_track_length:.2f} photos a point"),
            (
                "reprojection error",
                f"{model.median_error_px:.2f} px median, {model.mean_error_px:.2f} mean, "
                f"{model.p95_error_px:.2f} 95th percentile",
            ),
        ]
    putative, kept, verified = report.num_matches
    share = 100.0 / max(putative, 1)
    rows += [
        (
            "pairs",
            f"{len(report.pairs):,} matched, {report.num_verified_pairs:,} verified, "
            f"{report.num_empty_pairs:,} pruned to nothing",
        ),
        (
            "matches",
            f"{putative:,} putative → {kept:,} kept ({share * kept:.1f} %) "
            f"→ {verified:,} verified ({share * verified:.1f} %)",
        ),
        ("view graph", _components(report)),
    ]
    if report.stage_seconds:
        stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in report.stage_seconds.items())
        rows.append(("seconds", f"{sum(report.stage_seconds.values()):.1f}: {stages}"))
    return rows


def _in_models(report: SceneReport) -> str:
    """Photos in all models, if there are several."""
    return f", {report.num_in_models:,} in all models" if len(report.models) > 1 else ""


def _models(report: SceneReport) -> str:
    sizes = [str(model.num_images) for model in report.models]
    if not sizes:
        return "none"
    return (
        f"1, with {sizes[0]} photos" if len(sizes) == 1 else f"{len(sizes)}, with {', '.join(sizes)} photos"
    )


def _components(report: SceneReport) -> str:
    sizes = [len(component) for component in report.components]
    alone = len(report.image_names) - sum(sizes)
    photos = ", ".join(map(str, sizes))
    text = f"{len(sizes)} component{'' if len(sizes) == 1 else 's'}" + (
        f" of {photos} photos" if sizes else ""
    )
    return text + (f", {alone} without a verified pair" if alone else "")
