"""Models → statistics as JSON and text, and an HTML page with pictures.

::

    report/
    ├── stage.py        files to files
    ├── statistics.py   the statistics of a scene
    ├── missing.py      why photos are missing
    ├── table.py        the statistics as text
    ├── page.py         the HTML page, `write_html`
    ├── explained.py    its section on what the model explains
    ├── style.py        its look
    ├── charts.py       its drawings: histograms, bars, axes
    ├── pictures.py     its pictures: matches on photos, the view graph
    └── model_view.py   its view of the model, by plotly or still

Importing this package loads neither OpenCV nor pycolmap; `corrsfm.report.page` does.
"""

from corrsfm.report.missing import MissingPhoto, MissingReason
from corrsfm.report.statistics import SceneReport, StageWarning, make_report
from corrsfm.report.table import format_table

__all__ = ["MissingPhoto", "MissingReason", "SceneReport", "StageWarning", "format_table", "make_report"]
