"""Outliers in the report and the summary: a line for what belongs together, a chart of when, marks in the sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.models.outliers import GROSS, NLOS, SLIP
from factorgraph.solution import ResidualTable, Solution
from scenarios import metrics, solutions, writers
from scenarios.report import quality, signals, tables
from tests.scenarios.solution_example import example_solution


@pytest.fixture(scope="module")
def solution() -> Solution:
    """G-something blocked for twenty epochs; everything else good but for ten gross errors."""
    example = example_solution(80)
    table = example.residuals
    outlier_class = np.zeros(len(table.t_s), np.int64)
    blocked = np.flatnonzero((table.kind_index == table.kind.index("code")) & (table.label_index == 3))[20:40]
    outlier_class[blocked] = NLOS
    residual = table.residual.copy()
    residual[blocked] = 18.0
    gross = np.setdiff1d(np.flatnonzero(table.kind_index == table.kind.index("doppler")), blocked)[::97][:10]
    outlier_class[gross] = GROSS
    return replace(example, residuals=replace(table, residual=residual, outlier=outlier_class > 0, outlier_class=outlier_class))


def test_a_run_is_one_line(solution: Solution) -> None:
    html = tables.outliers(solution.residuals)
    table = solution.residuals
    span = [f"{t:.1f}" for t in table.t_s[table.outlier_class == NLOS][[0, -1]]]
    cells = ["code", "leader-rover G1C", table.label[3], "NLOS", *span, "20", "+18", "18", "m"]
    first = html[html.index("<tbody>") : html.index("</tr>", html.index("<tbody>"))]
    assert [c.split(">")[1].split("<")[0] for c in first.split("<td")[1:]] == cells
    assert "10 gross, 20 NLOS" in html


def test_the_timeline_has_every_outlier_once(solution: Solution) -> None:
    chart = quality.outlier_timeline(solution.residuals, 1000)
    assert chart is not None and chart.is_time
    drawn = {trace["name"]: trace for trace in chart.data}
    assert set(drawn) == {"gross", "NLOS"} and len(drawn["gross"]["x"]) == 10
    assert set(drawn["NLOS"]["y"]) == {solution.residuals.label[3]} and len(drawn["NLOS"]["x"]) == 20
    thinned = quality.outlier_timeline(solution.residuals, 5)
    assert thinned is not None and "10 of 30 outliers" in thinned.note
    assert quality.outlier_timeline(ResidualTable(), 5) is None


def test_the_sky_marks_what_lasts(solution: Solution) -> None:
    chart = signals.skyplot(solution.residuals)
    assert chart is not None
    marks = [trace for trace in chart.data if trace["name"] in ("gross", "multipath", "NLOS", "slip suspected")]
    assert [m["name"] for m in marks] == ["NLOS"] and len(marks[0]["theta"]) == 20
    rows = solution.residuals.outlier_class == NLOS
    np.testing.assert_allclose(marks[0]["r"], np.rad2deg(solution.residuals.elevation_rad[rows]), rtol=1e-4)


def test_the_summary_counts_classes(solution: Solution) -> None:
    rows = {row.quantity: row.value for row in metrics.summary_rows(solution) if row.subject == "solution"}
    assert rows["outliers"] == 30 and rows["outliers, NLOS"] == 20 and rows["outliers, gross"] == 10
    assert "outliers, slip suspected" not in rows and SLIP not in solution.residuals.outlier_class


def test_classes_survive_files(solution: Solution, tmp_path) -> None:  # type: ignore[no-untyped-def]
    solutions.save(solution, tmp_path / "s")
    loaded = solutions.load(tmp_path / "s").residuals
    np.testing.assert_array_equal(loaded.outlier_class, solution.residuals.outlier_class)
    table = writers._residual_table(solution)
    names = table.column("outlier_class").combine_chunks().to_pylist()
    assert names.count("nlos") == 20 and names.count("") == len(names) - 30
