"""The frame and look of every page: dark on light, for phones, wide screens and paper."""

from __future__ import annotations

import html

from corrsfm.files import PAGE_BEGINNING

__all__ = ["frame", "section"]

# Nothing is loaded from elsewhere; plotly compiles code at run time.
_POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline' 'unsafe-eval' blob:; worker-src blob:"
)

_STYLE = """
:root { --ink: #22262b; --quiet: #5c6670; --line: #d9d7d0; --paper: #faf9f6; --card: #ffffff;
  --bar: #2f6f9f; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.5 system-ui, -apple-system,
  "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
header, main { max-width: 1240px; margin: 0 auto; padding: 0 20px; }
header { padding-top: 28px; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0; overflow-wrap: anywhere; }
header p, .note, figcaption { color: var(--quiet); font-size: .9rem; margin: 4px 0 0; }
figcaption b { color: var(--ink); font-weight: 600; margin-right: 4px; }
h2 { font-size: 1.15rem; margin: 0 0 12px; }
section { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 18px 20px;
  margin: 18px 0; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px;
  margin: 18px 0; }
.tiles div { background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: 12px 16px; }
.tiles b { display: block; font-size: 1.55rem; line-height: 1.25; font-variant-numeric: tabular-nums; }
.tiles span { color: var(--quiet); font-size: .85rem; }
.scroll { overflow-x: auto; }
.tall { max-height: 480px; overflow-y: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: left; vertical-align: top; padding: 5px 18px 5px 0; border-bottom: 1px solid #eceae4; }
tr:last-child > * { border-bottom: 0; }
th { font-weight: 500; color: var(--quiet); white-space: nowrap; }
.numbers { margin-top: 14px; font-size: .93em; }
.numbers th, .numbers td { text-align: right; padding-right: 11px; }
.numbers td { white-space: nowrap; }
.numbers th { white-space: normal; vertical-align: bottom; }
.numbers.names td { white-space: normal; }
.numbers th:first-child, .numbers td:first-child, .names th:nth-child(2), .names td:nth-child(2) {
  text-align: left; }
.missing { width: 100%; }
.missing td:first-child { width: 1%; }
.missing td:nth-child(2) { overflow-wrap: anywhere; }
.missing .next::before { content: "→ "; }
.missing img { display: block; max-width: 96px; max-height: 72px; border-radius: 4px; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(280px, 1fr)); gap: 16px; }
.pairs { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 440px), 1fr)); gap: 18px; }
.graph { display: grid; grid-template-columns: minmax(0, 540px) minmax(220px, 1fr); gap: 24px; }
figure { margin: 0; }
.bars { max-width: 600px; }
svg { display: block; width: 100%; height: auto; }
svg .bar { fill: var(--bar); }
svg .grid { stroke: #e6e4dd; }
svg .frame { fill: none; stroke: var(--line); }
svg .mark { fill: none; stroke: var(--ink); stroke-linecap: round; }
svg .tick { font-size: 11px; fill: var(--quiet); }
svg .axis { font-size: 12.5px; fill: var(--ink); }
.wide { display: block; width: 100%; height: auto; border-radius: 4px; }
.model { border: 1px solid var(--line); border-radius: 6px; overflow: hidden; }
.legend { color: var(--quiet); font-size: .9rem; margin: 8px 0; }
.legend img { width: 110px; height: 12px; margin: 0 6px; vertical-align: -1px; border-radius: 2px; }
.legend i { display: inline-block; width: 14px; height: 14px; vertical-align: -2px; border-radius: 3px;
  margin: 0 4px 0 8px; border: 1px solid rgba(0, 0, 0, .15); }
.legend i:first-child { margin-left: 0; }
.crossed { background: #b23a0e; color: #000000; font: bold 14px/12px sans-serif; text-align: center; }
.grey { background: #dedede; }
.white { background: #ffffff; }
summary { cursor: pointer; color: var(--quiet); padding: 6px 0; }
ol, pre { font-size: .85rem; overflow: auto; max-height: 320px; overflow-wrap: anywhere; }
.verdict { border-left: 8px solid var(--line); background: var(--card); padding: 14px 18px; margin: 18px 0;
  overflow-wrap: anywhere; }
.verdict h2 { font-size: 1.35rem; margin: 0 0 6px; }
.verdict ul { margin: 0; padding-left: 20px; }
h3 { font-size: 1rem; margin: 20px 0 4px; }
.verdict h3 { margin-top: 12px; }
.lines { white-space: pre-line; overflow-wrap: anywhere; }
.readout { background: var(--paper); border: 1px solid var(--line); border-radius: 6px; padding: 8px 12px;
  min-height: 5.2em; overflow-wrap: anywhere; }
.verdict.good { border-color: #009e73; }
.verdict.doubtful { border-color: #e69f00; }
.verdict.wrong { border-color: #d55e00; }
.best { font-weight: 600; }
.failure { color: #a33; }
.numbers td.failure { text-align: left; white-space: normal; }
.kept { color: #2a7fb8; }
.dropped { color: #d55e00; }
@media (max-width: 720px) {
  header, main { padding-left: 12px; padding-right: 12px; }
  section { padding: 14px 12px; }
  .graph { grid-template-columns: minmax(0, 1fr); }
  .facts th { white-space: normal; }
  .missing tr { display: grid; grid-template-columns: 108px 1fr; border-bottom: 1px solid #eceae4; }
  .missing tr:last-child { border-bottom: 0; }
  .missing td { border-bottom: 0; }
  .missing td:first-child { width: auto; grid-row: span 2; }
}
@media print { section { break-inside: avoid; } body { background: #ffffff; } }
"""


def frame(title: str, subtitle: str, body: str) -> str:
    """A whole page that needs no other file.

    Parameters
    ----------
    title : str
        Plain text.
    subtitle, body : str
        HTML.
    """
    return (
        f'{PAGE_BEGINNING.decode()} content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)} · corrsfm</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<header><h1>{html.escape(title)}</h1><p>{subtitle}</p></header>\n<main>\n{body}\n</main>\n"
        "</body>\n</html>\n"
    )


def section(title: str, body: str) -> str:
    """A section under a heading, both HTML; nothing if the body is empty."""
    return f"<section><h2>{title}</h2>\n{body}\n</section>" if body else ""
