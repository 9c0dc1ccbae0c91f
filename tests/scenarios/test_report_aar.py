"""The page of the refuelling study: every figure of the publication has its counterpart, and parts may be missing."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
import pytest

from scenarios.report.aar import study_page, write_study
from scenarios.report.frame import Card, Page, Section, render_page
from scenarios.studies.aar_summary import DEFAULT, GRAPH, JobKey, summarise
from tests.scenarios.aar_results import MadeUp, made_up
from tests.scenarios.pages import assert_quiet_and_drawn, charts_of, open_page

HOSTILE = '</script><img src=x onerror="document.title=1">'


def _page(results: MadeUp, path: Path) -> str:
    return write_study(summarise(results), results, path, {"ratio threshold": 3, HOSTILE: HOSTILE}).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a whole study of a few seeds."""
    path = tmp_path_factory.mktemp("study") / "deep" / "report.html"
    _page(made_up(3), path)
    return path


def test_every_figure_has_its_counterpart(whole: Path) -> None:
    text = whole.read_text(encoding="utf-8")
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    shown = {int(n) for caption in captions for n in re.findall(r"Figure (\d+) of the paper", caption)}
    assert shown == set(range(3, 25))
    charts = charts_of(text)
    assert len(charts) == len(captions)
    for chart in charts:
        go.Figure({"data": chart["data"], "layout": chart["layout"]})  # raises on anything unknown
        assert all(len(trace.get("x", trace.get("r", []))) for trace in chart["data"])
    assert whole.stat().st_size < 15e6


def test_both_main_filters_and_the_readings_are_shown(whole: Path) -> None:
    text = whole.read_text(encoding="utf-8")
    (ratios,) = [c for c in charts_of(text) if c["layout"].get("xaxis", {}).get("type") == "multicategory"]
    assert [trace["name"] for trace in ratios["data"]] == ["SKF", "AKF", "published"]
    assert "Readings and departures" in text and text.index('id="readings"') < text.index('id="claims"')
    assert "with SKF | AKF" in text and "Data 3 is Data 1 to it" in text and "told the simulated noise" in text
    assert "What the robust schemes bring" in text
    visible = text.split('<script type="text/plain"')[0].lower()
    assert "acceptance" not in visible and "as published" not in visible and "after wu" in visible


def test_timelines_show_the_first_seed_with_shaded_windows(whole: Path) -> None:
    text = whole.read_text(encoding="utf-8")
    assert "Timelines show seed 1" in text
    shaded = [len(chart["layout"]["shapes"]) for chart in charts_of(text) if chart["layout"].get("shapes")]
    assert sorted(shaded) == [2, 2, 2, 2, 2, 2, 4, 4, 4]  # three timelines each of Data 2, 3 and 4


def test_only_the_first_seeds_are_loaded() -> None:
    results = made_up(3)
    summary = summarise(results)
    results.n_loaded = 0
    study_page(summary, results, {}, "relnav study aar")
    assert results.n_loaded == 4


PARTS: dict[str, tuple[MadeUp, tuple[str, ...]]] = {
    "nothing": (MadeUp([]), ("No data set was run.", "Data 3 was not run.", "Figure 7 of the paper")),
    "one data set": (made_up(1, (4,), (DEFAULT,)), ("Data 1 was not run.", "Not run: ", "Success rates want at least 50 seeds")),
    "some algorithms": (made_up(2, (2,), (DEFAULT,), ("3b", "4b"), 300), ("Not run on Data 2: WLS-SKF (1a), WLS-AKF (1b)",)),
    "the graph alone": (made_up(2, (1,), (DEFAULT,), (GRAPH,), 300), ("Figure 5 of the paper: ratio values (Data 1): no ratio",)),
    "no sweep": (made_up(2, (1,), (DEFAULT,), n_epochs=300), ("(300 s, Data 1): not run.",)),
    "the sweep alone": (MadeUp([JobKey("sweep", 1, 1)]), ("Data 1 was not run.",)),
}


@pytest.mark.parametrize("case", PARTS)
def test_what_is_missing_is_named(case: str, tmp_path: Path) -> None:
    results, reasons = PARTS[case]
    text = _page(results, tmp_path / "part.html")
    for reason in reasons:
        assert reason in text, reason
    for chart in charts_of(text):
        go.Figure({"data": chart["data"], "layout": chart["layout"]})


def test_trials_without_truth_or_sky_say_so(tmp_path: Path) -> None:
    class Bare(MadeUp):
        def __getitem__(self, key: JobKey) -> Any:
            dropped = (
                "truth_tanker_n",
                "truth_uav_n",
                "azimuth_deg",
                "elevation_deg",
                "n_sat",
                "baseline_m",
                "3b/velocity_error_mps",
            )
            return {name: value for name, value in super().__getitem__(key).items() if name not in dropped}

    text = _page(Bare(made_up(1, (1,), (DEFAULT,)).keys_, ("3b",), 300), tmp_path / "bare.html")
    for reason in ("no true positions", "no satellite directions", "velocity errors (Data 1): no errors were stored"):
        assert reason in text


def test_page_is_closed_to_foreign_text_and_the_network(whole: Path) -> None:
    text = whole.read_text(encoding="utf-8")
    assert "<img" not in text and text.count("</script>") == 3
    visible = text.split('<script type="text/plain"')[0]
    assert "http:" not in visible and "https:" not in visible and "default-src 'none'" in visible


def test_frame_holds_any_page() -> None:
    sections = [Section("a", "A", "A", html="<p>here</p>"), Section("b", "B", "B"), Section("c", "C", "C", absent="not here")]
    text = render_page(Page("title", "<heading>", sections, [Card("name", "1 < 2", "detail")], reasons=["careful"]))
    assert "&lt;heading&gt;" in text and "1 &lt; 2" in text and "careful" in text
    assert 'id="b"' not in text and "not here" in text
    assert charts_of(text) == []


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_page_is_drawn_in_a_browser(browser: Any, whole: Path, width: int, scheme: str) -> None:
    open_page(browser, whole, width, scheme)
    assert_quiet_and_drawn(browser, len(charts_of(whole.read_text(encoding="utf-8"))))
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    clashes = browser.execute_script(
        """
        return [...document.querySelectorAll('.js-plotly-plot')].filter(div => {
          const areas = [...div.querySelectorAll('.nsewdrag')].map(e => e.getBoundingClientRect().top);
          const legend = div.querySelector('.legend');
          return legend && areas.length && legend.getBoundingClientRect().bottom > Math.min(...areas) + 3;
        }).map(div => div.parentElement.querySelector('figcaption').textContent);
        """
    )
    assert json.dumps(clashes) == "[]"
