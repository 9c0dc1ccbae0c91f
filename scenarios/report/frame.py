"""The frame of every page: one HTML file that holds everything it needs, text, tables, data and plotly.js.

Layout: headline, key figures, a navigation that stays in view, sections. plotly.js and the charts lie in the page as
gzip in base64, which makes it three times smaller and keeps data apart from markup; `page.js` unpacks them with the
browser's own DecompressionStream (Chromium 80, Firefox 113, Safari 16.4). A content security policy forbids every
connection.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

from plotly.offline import get_plotlyjs, get_plotlyjs_version

from scenarios.report.chart import Chart
from scenarios.report.tables import folded, paragraph, text

OPEN_CHARTS = 8  # charts of a section drawn at once; the rest opens on demand

POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


@dataclass(frozen=True, slots=True)
class Section:
    """One part of the page. Without charts and HTML it says in one line why."""

    key: str
    title: str
    short: str  # in the navigation
    charts: Sequence[Chart] = ()
    html: str = ""
    absent: str = ""
    lead: str = ""
    open_charts: int = OPEN_CHARTS


@dataclass(frozen=True, slots=True)
class Card:
    """One key figure below the headline."""

    name: str
    value: str
    detail: str


@dataclass(frozen=True, slots=True)
class Page:
    """What a page says; `render` makes HTML of it. Texts are plain, except `lines`, which are HTML already."""

    title: str  # of the browser's window
    heading: str
    sections: Sequence[Section]
    cards: Sequence[Card] = ()
    badge: str = ""
    badge_is_good: bool = True
    lines: Sequence[str] = ()  # below the heading
    reasons: Sequence[str] = ()  # warnings
    maker: str = "relnav"  # in the footer
    controls: str = ""  # HTML that stays in view with the navigation
    script: str = ""  # a file beside this one that serves the controls


def write_page(page: Page, path: Path) -> Path:
    """Write a page as one self-contained HTML file; folders are made. Returns the path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(render_page(page), encoding="utf-8")
    return path


def render_page(page: Page) -> str:
    """The page as text; sections with neither content nor a reason for its absence are left out."""
    parts = [section for section in page.sections if section.charts or section.html or section.absent]
    drawn = [chart for section in parts for chart in section.charts]
    payload = json.dumps([_as_json(chart) for chart in drawn], separators=(",", ":"), allow_nan=False)
    body, first = [], 0
    for section in parts:
        body.append(_section_html(section, first))
        first += len(section.charts)
    links = "".join(f'<a href="#{section.key}">{text(section.short)}</a>' for section in parts)
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="color-scheme" content="light dark">\n<link rel="icon" href="data:,">',
            f"<title>{text(page.title)}</title>",
            f"<style>\n{_asset('page.css')}</style>\n</head>\n<body>",
            _headline(page),
            f'<nav aria-label="Sections"><div>{links}</div>{page.controls}</nav>',
            f"<main>{''.join(body)}</main>",
            _footer(page.maker),
            '<noscript><p class="note">The plots of this page need JavaScript.</p></noscript>',
            f'<script type="text/plain" id="packed-plotly">{_packed_plotly()}</script>',
            f'<script type="text/plain" id="packed-charts">{_pack(payload)}</script>',
            *([f"<script>\n{_asset(page.script)}</script>"] if page.script else []),
            f"<script>\n{_asset('page.js')}</script>\n</body>\n</html>\n",
        ]
    )


def _headline(page: Page) -> str:
    colour = "good" if page.badge_is_good else "bad"
    badge = f'<span class="badge {colour}">{text(page.badge)}</span>' if page.badge else ""
    lines = "".join(f'<p class="when">{line}</p>' for line in page.lines)
    listed = "".join(f"<li>{text(reason)}</li>" for reason in page.reasons)
    warning = f'<ul class="reasons" aria-label="Warnings">{listed}</ul>' if page.reasons else ""
    cards = "".join(
        f'<div class="card"><span>{text(card.name)}</span><b>{text(card.value)}</b><small>{text(card.detail)}</small></div>'
        for card in page.cards
    )
    return f'<header><div><h1>{text(page.heading)}</h1>{badge}</div>{lines}{warning}<div class="cards">{cards}</div></header>'


def _footer(maker: str) -> str:
    plots = f"Plots by plotly.js {get_plotlyjs_version()} (MIT licence), inside this page."
    return f"<footer><p>{text(maker)}. {text(plots)}</p></footer>"


def _section_html(section: Section, first: int) -> str:
    if not section.charts and not section.html:
        inner = paragraph(section.absent)
    else:
        places = [_place(chart, first + i) for i, chart in enumerate(section.charts)]
        inner = f'<p class="note">{text(section.lead)}</p>' if section.lead else ""
        inner += section.html
        inner += f'<div class="charts">{"".join(places[: section.open_charts])}</div>' if places else ""
        if places[section.open_charts :]:
            rest = f'<div class="charts">{"".join(places[section.open_charts :])}</div>'
            inner += folded(f"Show {len(places) - section.open_charts} more plots", rest)
    return f'<section id="{section.key}"><h2>{text(section.title)}</h2>{inner}</section>'


def _place(chart: Chart, index: int) -> str:
    size = "wide" if chart.wide else "half"
    note = paragraph(chart.note) if chart.note else ""
    # titles are escaped for plotly and HTML alike where they are made
    return (
        f'<figure class="{size}"><figcaption>{chart.title}</figcaption>'
        f'<div class="plot" data-chart="{index}" style="height:{chart.height_px}px"></div>{note}</figure>'
    )


def _as_json(chart: Chart) -> dict[str, object]:
    return {"data": chart.data, "layout": chart.layout, "height": chart.height_px, "time": chart.is_time}


def _pack(content: str) -> str:
    return base64.b64encode(gzip.compress(content.encode(), 6, mtime=0)).decode()


@lru_cache(maxsize=1)
def _packed_plotly() -> str:
    return _pack(get_plotlyjs())


@lru_cache
def _asset(name: str) -> str:
    return files("scenarios.report").joinpath(name).read_text(encoding="utf-8")
