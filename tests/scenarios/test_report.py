"""Metrics against hand-made cases, the page in a real browser, and solutions with parts missing."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import pytest
from matplotlib.figure import Figure
from scipy.stats import chi2

from factorgraph.attitude import euler_from_matrix, exp_so3, matrix_from_euler, quat_from_matrix
from factorgraph.consistency import standard_deviations
from factorgraph.measurements import Truth
from factorgraph.solution import (
    ATT,
    POS,
    AmbiguityTable,
    Diagnostics,
    Fix,
    ParameterEstimate,
    ResidualTable,
    Solution,
    Status,
    VehicleSolution,
)
from factorgraph.types import Array
from scenarios import metrics
from scenarios.report import figures, page, series
from scenarios.report.figures import write_figures
from scenarios.report.page import write_report
from tests.helpers import numerical_jacobian
from tests.scenarios.pages import assert_quiet_and_drawn, charts_of, open_page
from tests.scenarios.solution_example import example_solution, with_base

HOSTILE = '</script><img src=x onerror="document.title=1"><b>&"'
PHONE_WIDTH = 390


# Metrics


def test_statistics_of_known_errors() -> None:
    stats = metrics.statistics(np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0], [np.nan, 1.0, 1.0], [0.0, 6.0, 8.0]]))
    assert stats.n == 3
    assert stats.rmse == pytest.approx(np.sqrt(125 / 3))
    assert (stats.median, stats.maximum) == (5.0, 10.0)
    assert np.isnan(metrics.statistics(np.full((4, 3), np.nan)).rmse)


def test_cdf_is_the_share_not_above() -> None:
    size, share = metrics.cdf(np.array([-2.0, 1.0, np.nan, 3.0, 0.5]))
    np.testing.assert_allclose(size, [0.5, 1, 2, 3])
    np.testing.assert_allclose(share, [0.25, 0.5, 0.75, 1])


@pytest.mark.parametrize("optimism", [1.0, 3.0, 1 / 3])
def test_nees_band_holds_95_percent_only_of_honest_errors(optimism: float) -> None:
    rng = np.random.default_rng(11)
    n, sigma = 4000, np.array([0.1, 0.2, 0.4])
    P = np.tile(np.diag((sigma / optimism) ** 2), (n, 1, 1))
    error: Array = sigma * rng.standard_normal((n, 3))
    found = metrics.ErrorSeries("a", "position", "m", ("east", "north", "up"), np.linspace(0, 1, n), error, P)
    lower, upper = np.diff(chi2.cdf(np.array(chi2.interval(0.95, 3)) / optimism**2, 3)) + np.array([-1, 1]) * 4 * 0.5 / np.sqrt(n)
    assert lower < found.nees.share_inside < upper
    assert (lower > 0.9) == (optimism == 1.0)


def _vehicle(t_s: Array, phi: Array | None = None) -> tuple[VehicleSolution, Callable[[Array], Truth]]:
    """A smooth flight whose truth can be asked at any time; the estimate differs by the attitude error phi."""

    def truth(at_s: Array) -> Truth:
        r = np.column_stack([30 * np.sin(at_s / 5), 30 * np.cos(at_s / 5), 0.1 * at_s**2])
        v = np.column_stack([6 * np.cos(at_s / 5), -6 * np.sin(at_s / 5), 0.2 * at_s])
        C = matrix_from_euler(0.1 * np.sin(at_s), 0.3 * np.cos(at_s / 2), at_s / 5)
        return Truth(at_s, r, v, quat_from_matrix(C))

    known, n = truth(t_s), len(t_s)
    assert known.v_n is not None and known.q_nb is not None
    turn = exp_so3(np.zeros(3) if phi is None else -phi)
    C = turn @ matrix_from_euler(0.1 * np.sin(t_s), 0.3 * np.cos(t_s / 2), t_s / 5)
    P = np.tile(np.eye(15), (n, 1, 1))
    nan = np.full((n, 3), np.nan)
    return VehicleSolution("a", t_s, known.r_n, known.v_n, quat_from_matrix(C), nan, nan, P, None), truth


@pytest.mark.parametrize("truth_step_s", [0.23, 0.13], ids=["truth is sparser", "truth is denser"])
def test_vehicle_errors_are_taken_at_the_sparser_times(truth_step_s: float) -> None:
    phi = np.array([1e-3, -2e-3, 5e-3])
    vehicle, truth = _vehicle(np.arange(0, 40, 0.2), phi)
    position, velocity, attitude = metrics.vehicle_errors(replace(vehicle, truth=truth(np.arange(-1.0, 50.0, truth_step_s))))
    assert position.t_s[0] >= 0 and position.t_s[-1] <= vehicle.t_s[-1]
    assert len(position.t_s) == len(attitude.t_s) > 165
    assert np.abs(position.error).max() < 1e-5  # a straight line between the epochs would miss by 6 mm
    assert np.abs(velocity.error).max() < 0.01
    np.testing.assert_allclose(attitude.error, np.tile(phi, (len(attitude.t_s), 1)), atol=1.5e-3)
    np.testing.assert_allclose(attitude.error.mean(axis=0), phi, atol=1e-4)


def test_truth_inside_a_gap_is_not_compared_but_epochs_beside_it_are() -> None:
    t_s = np.concatenate([np.arange(0, 10, 0.5), np.arange(20, 30, 0.5)])
    vehicle, truth = _vehicle(t_s)
    position = metrics.vehicle_errors(replace(vehicle, truth=truth(np.arange(0, 30, 0.5))))[0]
    assert set(t_s) <= set(position.t_s)
    assert not np.any((position.t_s > 9.5) & (position.t_s < 20))


def test_pair_errors_need_truth_and_keep_the_sign() -> None:
    pair = example_solution(50).pairs[0]
    baseline, velocity = metrics.pair_errors(pair)
    assert pair.truth_enu is not None
    np.testing.assert_allclose(baseline.error, pair.baseline_enu - pair.truth_enu)
    assert (baseline.subject, velocity.unit) == ("leader → rover", "m/s")
    assert metrics.pair_errors(replace(pair, truth_enu=np.full_like(pair.truth_enu, np.nan), truth_velocity_enu=None)) == []


@pytest.mark.parametrize("euler", [(0.1, -0.4, 2.0), (-1.2, 0.8, -3.0), (1.4, 3.0, 0.0)])
def test_euler_sigma_agrees_with_finite_differences(euler: tuple[float, float, float]) -> None:
    C = matrix_from_euler(*euler)
    A = np.random.default_rng(5).standard_normal((3, 3))
    P = 1e-6 * A @ A.T
    J = numerical_jacobian(lambda phi: np.array(euler_from_matrix(exp_so3(-phi) @ C)), 3, 1e-5)
    sigma = metrics.euler_sigma(quat_from_matrix(C)[None], P[None])[0]
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(J @ P @ J.T)), rtol=1e-5)


def test_euler_sigma_is_unknown_with_the_nose_up_or_without_covariance() -> None:
    q = quat_from_matrix(np.stack([matrix_from_euler(np.pi / 2, 0, 0), np.eye(3)]))
    P = np.stack([np.eye(3), np.full((3, 3), np.nan)])
    assert np.isnan(metrics.euler_sigma(q, P)).all()


def test_summary_rows_say_what_the_solution_holds() -> None:
    solution = example_solution(400)
    rows = {(row.subject, row.quantity): row for row in metrics.summary_rows(solution)}
    pair = solution.pairs[0]
    fixed = rows["leader → rover", "integers fixed"]
    assert fixed.value == pytest.approx(100 * np.mean(pair.fix == Fix.FIXED.value))
    assert fixed.text.endswith(" %")
    assert rows["leader → rover", "fixed baseline error RMS"].value < rows["leader → rover", "baseline error RMS"].value
    assert rows["rover", "attitude error RMS"].unit == "°"
    assert rows["solution", "outliers"].value == np.sum(solution.residuals.outlier)
    assert metrics.SummaryRow("a", "b", float("nan"), "m").text == "–"
    base = {row.subject for row in metrics.summary_rows(with_base(solution))}
    assert "base" not in base and "base → rover" in base


# Series


def test_thinning_keeps_first_last_and_extremes() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.standard_normal(100_001), rng.standard_normal(100_001)
    a[777], b[55_555], a[3] = 50.0, -60.0, np.nan
    rows = series.thin(2000, a, b)
    assert len(rows) <= 2002
    assert {0, 777, 55_555, 100_000} <= set(rows.tolist())
    assert np.all(np.diff(rows) > 0)
    assert series.thin(2000, a[:1500]).tolist() == list(range(1500))
    assert len(series.thin(100, np.full(5000, np.nan))) <= 102


def test_numbers_are_short_and_unknown_ones_null() -> None:
    assert series.numbers(np.array([1 / 3, 0.0, np.nan, -12345.678901, np.inf, 1e-9]), 4) == [
        0.3333,
        0.0,
        None,
        -12350.0,
        None,
        1e-9,
    ]


def test_lines_and_bands_break_at_gaps_and_unknown_sigmas() -> None:
    t_s = np.array([0.0, 1, 2, 3, 50, 51, 52])
    y, sigma = np.arange(7.0), np.array([1.0, 1, 1, 1, 1, np.nan, 1])
    area, curve = series.with_band("a", "m", t_s, y, sigma, "#000000", 100)
    assert curve["x"].count(None) == 1 and curve["y"][4] is None
    assert area["x"].count(None) == 3  # closes the polygons 0..3, 50 and 52
    assert max(v for v in area["y"] if v is not None) == 9.0
    assert len(series.with_band("a", "m", t_s, y, np.full(7, np.nan), "#000000", 100)) == 1


# Page without a browser


def _no_pairs(s: Solution) -> Solution:
    return replace(s, pairs=())


def _nan_covariance(s: Solution) -> Solution:
    vehicles = tuple(replace(v, P=np.full_like(v.P, np.nan)) for v in s.vehicles)
    return replace(s, vehicles=vehicles, pairs=tuple(replace(p, P=np.full_like(p.P, np.nan)) for p in s.pairs))


def _bare(s: Solution) -> Solution:
    """Nothing but a trajectory, and a solver that gave up."""
    return replace(
        s,
        pairs=(),
        vehicles=s.vehicles[:1],
        residuals=ResidualTable(),
        ambiguities=AmbiguityTable(),
        diagnostics=Diagnostics(Status.SINGULAR, 0, np.zeros(0), warnings=("no ephemeris for 3 satellites",)),
        configuration={},
        versions={},
    )


def _no_imu(s: Solution) -> Solution:
    def bare(v: VehicleSolution) -> VehicleSolution:
        P = v.P.copy()
        P[:, 6:], P[:, :, 6:] = np.nan, np.nan
        nan = np.full_like(v.bias_gyro, np.nan)
        return replace(v, q_nb=np.full_like(v.q_nb, np.nan), bias_gyro=nan, bias_accel=nan, P=P)

    return replace(s, vehicles=tuple(bare(v) for v in s.vehicles))


def _no_fix(s: Solution) -> Solution:
    pair = s.pairs[0]
    return replace(
        s, pairs=(replace(pair, fix=np.zeros_like(pair.fix), ratio=np.full_like(pair.ratio, np.nan), n_sat=0 * pair.n_sat),)
    )


def _many(s: Solution) -> Solution:
    names = [f"v{i}" for i in range(12)]
    vehicles = tuple(replace(s.vehicles[i % 2], name=name) for i, name in enumerate(names))
    return replace(s, vehicles=vehicles, pairs=tuple(replace(s.pairs[0], reference="v0", rover=name) for name in names[1:]))


def _hostile(s: Solution) -> Solution:
    vehicles = tuple(replace(v, name=v.name + HOSTILE) for v in s.vehicles)
    pair = replace(s.pairs[0], reference="leader" + HOSTILE, rover="rover" + HOSTILE)
    table = replace(s.residuals, kind=("code" + HOSTILE, *s.residuals.kind[1:]), label=("G" + HOSTILE, *s.residuals.label[1:]))
    arcs = replace(s.ambiguities, link=tuple(name + HOSTILE for name in s.ambiguities.link))
    judged = replace(
        s.diagnostics,
        warnings=(HOSTILE,),
        notes=(HOSTILE,),
        parameters=(ParameterEstimate(HOSTILE, HOSTILE, 1.0, 0.1, 0.0, 1.0),),
        runtime_s={HOSTILE: 1.0},
    )
    return replace(
        s, name="flight" + HOSTILE, method=HOSTILE, vehicles=vehicles, pairs=(pair,), residuals=table, ambiguities=arcs,
        diagnostics=judged, configuration={HOSTILE: HOSTILE}, versions={HOSTILE: HOSTILE},
    )  # fmt: skip


CASES: dict[str, Callable[[], Solution]] = {
    "whole": lambda: example_solution(80),
    "no truth": lambda: example_solution(80, with_truth=False),
    "no pairs": lambda: _no_pairs(example_solution(80)),
    "no covariance": lambda: _nan_covariance(example_solution(80)),
    "no residuals": lambda: replace(example_solution(80), residuals=ResidualTable()),
    "no inertial sensor": lambda: _no_imu(example_solution(80)),
    "no phase": lambda: _no_fix(example_solution(80)),
    "base station": lambda: with_base(example_solution(80)),
    "one epoch": lambda: example_solution(1),
    "two epochs": lambda: example_solution(2),
    "no epoch": lambda: _bare(example_solution(1)),
    "bare": lambda: _bare(example_solution(80)),
    "many": lambda: _many(example_solution(60)),
    "hostile names": lambda: _hostile(example_solution(80)),
}


@pytest.mark.parametrize("case", CASES)
def test_every_chart_fits_the_schema_of_plotly(case: str) -> None:
    solution = CASES[case]()
    if case == "no epoch":
        leader = solution.vehicles[0]
        none = {name: getattr(leader, name)[:0] for name in ("t_s", "r_n", "v_n", "q_nb", "bias_gyro", "bias_accel", "P")}
        solution = replace(solution, vehicles=(replace(leader, **none),))
    charts = charts_of(page.render(solution))
    assert len(charts) > (20 if case in ("whole", "many", "hostile names") else -1)
    for chart in charts:
        go.Figure({"data": chart["data"], "layout": chart["layout"]})  # raises on anything unknown
        assert all(len(trace.get("x", trace.get("r", []))) for trace in chart["data"])


def test_missing_parts_are_named_or_left_out() -> None:
    text = page.render(_bare(example_solution(30)))
    for reason in ("The solution holds no pairs.", "The solution holds no residuals.", "No satellites were used."):
        assert reason in text
    assert 'id="configuration"' not in text and "singular" in text and "degraded" in text
    assert "no ephemeris for 3 satellites" in text
    assert "done</span>" in page.render(example_solution(30))
    assert "No truth is known" in page.render(example_solution(30, with_truth=False))
    base = page.render(with_base(example_solution(30)))
    assert "<figcaption>base: gyroscope" not in base and "<figcaption>rover: gyroscope" in base


def test_text_from_input_cannot_leave_its_place() -> None:
    text = page.render(_hostile(example_solution(30)))
    assert "<img" not in text
    assert text.count("</script>") == 3
    for chart in charts_of(text):
        drawn = json.dumps([[t.get(k, "") for k in ("name", "hovertemplate", "text")] for t in chart["data"]])
        assert "<img" not in drawn and "</script" not in drawn


def test_page_names_no_address_to_load_from() -> None:
    text = page.render(example_solution(30))
    visible = text.split('<script type="text/plain"')[0]
    assert "http:" not in visible and "https:" not in visible and "src=" not in visible and "@import" not in visible
    assert "default-src 'none'" in visible


def test_long_solutions_stay_small_and_say_so(tmp_path: Path) -> None:
    solution = example_solution(100_000)
    start = time.process_time()
    path = write_report(solution, tmp_path / "deep" / "report.html")
    assert time.process_time() - start < 20  # about 4 s, more when the machine is busy
    text = path.read_text(encoding="utf-8")
    assert path.stat().st_size < 5.2e6
    assert "of 100,000 epochs a curve; extremes are kept." in text
    for chart in charts_of(text):
        for trace in chart["data"]:
            assert len(trace.get("x", ())) <= (4200 if trace.get("fill") == "toself" else 2100)


def test_figures_are_written_for_what_is_there(tmp_path: Path) -> None:
    names = {path.name for path in write_figures(with_base(example_solution(40, with_truth=False)), tmp_path)}
    assert names == {
        "track-base-rover.png",
        "baseline-base-rover.png",
        "velocity-base-rover.png",
        "attitude-rover.png",
        "residuals.png",
    }
    assert all((tmp_path / name).read_bytes().startswith(b"\x89PNG") for name in names)
    lonely = replace(_no_imu(_bare(example_solution(3))), vehicles=example_solution(3).vehicles[:1])
    assert "error-attitude-leader.png" in {path.name for path in write_figures(lonely, tmp_path)}


def test_figure_functions_label_units_and_three_sigma() -> None:
    found = metrics.solution_errors(example_solution(40))[-1]
    ax = figures.errors(found, 2, Figure().subplots())
    assert ax.get_ylabel() == "up [°]" and "±3σ" in [artist.get_label() for artist in ax.collections]
    np.testing.assert_allclose(np.asarray(ax.lines[0].get_ydata(), float), np.rad2deg(found.error[:, 2]))
    assert figures.error_cdf(found, Figure().subplots()).get_xlabel() == "attitude error, 3D [°]"


# Page in a browser


def test_page_on_a_desk_draws_everything_and_runs_nothing_foreign(browser: Any, tmp_path: Path) -> None:
    solution = _hostile(example_solution(60))
    path = write_report(solution, tmp_path / "desk.html")
    open_page(browser, path, 1280)
    browser.execute_script("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    deadline = time.monotonic() + 90
    while browser.execute_script("return document.querySelectorAll('.plot:not(.js-plotly-plot)').length"):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert_quiet_and_drawn(browser, len(charts_of(path.read_text(encoding="utf-8"))))
    assert browser.title.startswith("flight</script><img")
    assert browser.execute_script("return document.querySelector('h1').textContent") == solution.name
    assert browser.execute_script("return document.images.length") == 0
    legend = browser.execute_script("return [...document.querySelectorAll('.legendtext')].map(e => e.textContent)")
    assert "leader" + HOSTILE in legend
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 1280


def test_page_on_a_phone_fits_and_legends_keep_clear(browser: Any, tmp_path: Path) -> None:
    path = write_report(example_solution(60), tmp_path / "phone.html")
    open_page(browser, path, PHONE_WIDTH, "dark")
    assert browser.get_log("browser") == []
    assert browser.execute_script("return document.documentElement.scrollWidth") <= PHONE_WIDTH
    background = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert background == "rgb(18, 22, 28)"
    clashes = browser.execute_script(
        """
        const clashes = [];
        for (const div of document.querySelectorAll('.js-plotly-plot')) {
          const outer = div.getBoundingClientRect();
          const areas = [...div.querySelectorAll('.nsewdrag')].map(e => e.getBoundingClientRect().top);
          const legend = div.querySelector('.legend');
          if (!legend || !areas.length) continue;
          const box = legend.getBoundingClientRect();
          if (box.bottom > Math.min(...areas) + 3 || box.right > outer.right + 1 || box.top < outer.top - 1)
            clashes.push(div.parentElement.querySelector('figcaption').textContent);
        }
        return clashes;
        """
    )
    assert clashes == []


def test_zoom_in_time_moves_the_other_plots(browser: Any, tmp_path: Path) -> None:
    solution = replace(_no_pairs(example_solution(40)), residuals=ResidualTable())
    open_page(browser, write_report(solution, tmp_path / "zoom.html"), 1280)
    browser.execute_script(
        "Plotly.relayout(document.querySelector('#attitude .plot'), {'xaxis.range[0]': 5, 'xaxis.range[1]': 9})"
    )
    wanted = "return [...document.querySelectorAll('#biases .plot')].slice(0, 2).map(d => d.layout.xaxis.range.join())"
    browser.execute_script("document.querySelector('#biases').scrollIntoView({behavior: 'instant'})")
    deadline = time.monotonic() + 60
    while set(browser.execute_script(wanted)) != {"5,9"}:
        assert time.monotonic() < deadline, browser.execute_script(wanted)
        time.sleep(0.05)
    assert browser.get_log("browser") == []


def test_bare_page_opens_without_complaint(browser: Any, tmp_path: Path) -> None:
    path = write_report(_nan_covariance(_bare(example_solution(1))), tmp_path / "bare.html")
    open_page(browser, path, PHONE_WIDTH)
    assert_quiet_and_drawn(browser, len(charts_of(path.read_text(encoding="utf-8"))))
    assert browser.execute_script("return document.documentElement.scrollWidth") <= PHONE_WIDTH


def test_blocks_of_the_example_obey_its_covariances() -> None:
    vehicle = example_solution(3000).vehicles[0]
    assert vehicle.truth is not None
    for block, found in zip((POS, ATT), (0, 2), strict=True):
        series_of_block = metrics.vehicle_errors(vehicle)[found]
        share = np.mean(np.abs(series_of_block.error) < standard_deviations(vehicle.P[:, block, block]))
        assert 0.5 < share < 0.85  # 0.68, errors of neighbouring epochs are correlated
