"""Models → statistics as JSON and text, and an HTML page with pictures."""

from corrsfm.report.scene import MissingImage, MissingReason, SceneReport, make_report
from corrsfm.report.table import format_table

__all__ = ["MissingImage", "MissingReason", "SceneReport", "format_table", "make_report"]
