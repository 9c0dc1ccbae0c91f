"""Statistics, claims and the record of the refuelling study, on made-up results with effects of known size."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from factorgraph.errors import InputError
from factorgraph.types import Array
from scenarios.studies import aar_claims, aar_record, aar_summary, verdicts
from scenarios.studies.aar_claims import claims
from scenarios.studies.aar_summary import DEFAULT, GRAPH, Cell, JobKey, Summary, from_json, summarise, to_json
from scenarios.studies.document import json_text
from scenarios.studies.statistics import NAN, Statistic
from scenarios.studies.verdicts import Claim, Verdict
from tests.helpers import ROOT
from tests.scenarios.aar_results import SUCCESS, MadeUp, made_up, trial

N_SEEDS = 6


@pytest.fixture(scope="module")
def summary() -> Summary:
    extra = made_up(N_SEEDS, (1,), ("literal-noise", "start", "normalised"))
    return summarise(MadeUp(made_up(N_SEEDS).keys_ + extra.keys_))


def _claim(summary: Summary, id: str) -> Claim:
    (found,) = [claim for claim in claims(summary) if claim.id == id]
    return found


# one trial


def _hand_made() -> dict[str, Array]:
    """Ten epochs of 3b: right and fixed at 0 to 5, wrongly fixed at 6, float at 7 to 9; faulted at 4, 5 and 8."""
    error = np.zeros((10, 3))
    error[:, 0] = [1, 1, 1, 1, 2, 2, 10, 3, 3, np.nan]
    return {
        "t_s": np.arange(10.0),
        "faulted": np.isin(np.arange(10), (4, 5, 8)),
        "3b/correct": np.arange(10) < 6,
        "3b/fixed": np.arange(10) < 7,
        "3b/ratio": np.array([4, 4, 4, 4, 5, 7, 3, np.inf, 2, np.nan]),
        "3b/baseline_error_m": error,
        "3b/velocity_error_mps": np.zeros((10, 3)),
        "3b/alpha": np.array([1, 1, 1, 1, 1, 0.5, 0.5, 1, 1, 1]),
        "3b/runtime_s": np.array(2.5),
    }


def test_numbers_of_a_trial_by_hand() -> None:
    found = aar_summary.measure(_hand_made(), "3b", 2)
    assert (found["p_corr"], found["p_fix"], found["p_se"]) == pytest.approx((60, 70, 60))
    assert found["wrong_fix"] == pytest.approx(100 / 7)
    assert found["ratio_median"] == 4 and found["ratio_mean"] == pytest.approx((16 + 5 + 7 + 3 + 1000 + 2) / 9)
    assert found["baseline_rms"] == pytest.approx(np.sqrt((4 + 8 + 100 + 18) / 9))
    assert found["baseline_max_fixed"] == 10 and found["baseline_mean"] == pytest.approx(24 / 9)
    assert found["fault_ratio_median"] == 5 and found["fault_p_se"] == pytest.approx(200 / 3)
    assert found["fault_ratio_median@4"] == 6 and found["fault_baseline_max@8"] == 3
    assert found["adapted_wrong"] == 100 and found["adapted_right"] == pytest.approx(100 / 6)
    assert found["runtime"] == 2.5
    assert "nees_mean" not in found and "velocity_manoeuvre" not in found
    assert "velocity_manoeuvre" in aar_summary.measure(trial(JobKey(DEFAULT, 1, 1)), "3a", 1)


def test_the_graph_has_no_share_of_right_integer_solutions(summary: Summary) -> None:
    found = aar_summary.measure(trial(JobKey(DEFAULT, 1, 1)), GRAPH, 1)
    assert "p_corr" not in found and {"p_fix", "p_se", "wrong_fix"} <= set(found)
    (rates,) = [t for t in aar_record.tables(summary) if t.title == "Ambiguities, Data 4"]
    assert rates.rows[-1][:2] == ("factor graph", "–") and rates.rows[-1][3] != "–"
    assert aar_record.GRAPH_FIXED in rates.note and "code errors alone" in rates.note


def test_windows_are_the_unbroken_runs() -> None:
    assert aar_summary.windows(np.array([True, True, False, True])) == [slice(0, 2), slice(3, 4)]
    assert aar_summary.windows(np.zeros(3, bool)) == []


# over the seeds


def test_means_and_intervals_cover_what_was_put_in(summary: Summary) -> None:
    found = summary.statistic("p_se", "2b", 1)
    assert found is not None and found.n == N_SEEDS
    assert found.low <= found.lower <= found.value <= found.upper <= found.high
    assert found.value == pytest.approx(100 * SUCCESS["2"], abs=1.5)
    arrays = [trial(JobKey(DEFAULT, 1, seed)) for seed in range(1, N_SEEDS + 1)]
    assert found.value == pytest.approx(100 * np.mean([a["2b/correct"] & a["2b/fixed"] for a in arrays]), rel=1e-3)


def test_differences_are_paired_over_common_seeds() -> None:
    keys = [*made_up(4, (1,), (DEFAULT,), ("2b",)).keys_, *made_up(4, (2,), (DEFAULT,), ("2b",)).keys_[1:]]
    found = summarise(MadeUp(keys, ("2b",))).difference("p_se", Cell(DEFAULT, 1, "2b"), Cell(DEFAULT, 2, "2b"))
    assert found is not None and found.difference.n == 3
    # same draws outside the windows: what is lost lies in the 44 epochs, the interval is far narrower than that of either
    assert found.difference.upper - found.difference.lower < 1.0
    assert found.difference.value == pytest.approx(-100 * 44 / 1201 * SUCCESS["2"], abs=0.5)
    assert (found.better, found.worse) == (0, 3)


def test_intervals_shrink_with_the_seeds_and_are_unknown_of_one() -> None:
    widths = {}
    for n in (1, 5, 20):
        s = summarise(made_up(n, (1,), (DEFAULT,), ("1a",), 300)).statistic("p_se", "1a", 1)
        assert s is not None
        widths[n] = s.upper - s.lower
    assert np.isnan(widths[1]) and widths[20] < widths[5]


def test_inconsistent_covariances_are_marked(summary: Summary) -> None:
    honest, optimistic = summary.row("1b", 1), summary.row("1a", 1)
    assert honest is not None and optimistic is not None
    assert honest.is_consistent and honest.nees_consistent > 95
    assert not optimistic.is_consistent


def test_one_trial_is_loaded_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    results = made_up(3, (1, 2), (DEFAULT,), ("1a", "3b"), 300)
    live: list[JobKey] = []

    class Watched(dict[str, Array]):
        def __init__(self, key: JobKey, content: Mapping[str, Array]) -> None:
            super().__init__(content)
            live.append(key)

        def __del__(self) -> None:
            live.pop()

    original = MadeUp.__getitem__
    most = 0

    def watched(self: MadeUp, key: JobKey) -> Mapping[str, Array]:
        nonlocal most
        found = Watched(key, original(self, key))
        most = max(most, len(live))
        return found

    monkeypatch.setattr(MadeUp, "__getitem__", watched)
    summarise(results)
    assert results.n_loaded == 6 and most <= 2  # the one before goes when the next one is there


def test_trials_of_other_length_are_an_error() -> None:
    results = {JobKey(DEFAULT, 1, 1): trial(JobKey(DEFAULT, 1, 1), ("1a",), 300)}
    results[JobKey(DEFAULT, 1, 2)] = trial(JobKey(DEFAULT, 1, 2), ("1a",), 301)
    with pytest.raises(InputError, match="301 epochs, other trials of this data set have 300"):
        summarise(results)


def test_nothing_run_is_an_empty_summary() -> None:
    assert summarise({}) == Summary()
    assert {claim.verdict for claim in claims(Summary())} == {Verdict.NOT_TESTED}


# claims


@pytest.mark.parametrize(
    ("found", "value", "verdict"),
    [
        (Statistic(90, 89, 91, 86, 94, 9), 93.5, Verdict.REPRODUCED),  # a seed gives it
        (Statistic(90, 89, 91, 89, 91, 9), 92.5, Verdict.REPRODUCED),  # near the mean
        (Statistic(90, 89, 91, 89, 91, 9), 97.0, Verdict.PARTLY),
        (Statistic(90, 89, 91, 89, 91, 9), 57.0, Verdict.NOT_REPRODUCED),
    ],
)
def test_verdict_of_a_number(found: Statistic, value: float, verdict: Verdict) -> None:
    assert verdicts.near(found, value, 3, 10) is verdict


def test_verdicts_of_bounds_and_differences() -> None:
    assert verdicts.at_most(Statistic(1, 0.9, 1.1, 0, 2, 9), 1.2) is Verdict.REPRODUCED
    assert verdicts.at_most(Statistic(1, 0.9, 1.1, 0, 2, 9), 1.0) is Verdict.PARTLY
    assert verdicts.at_most(Statistic(1, NAN, NAN, 1, 1, 1), 0.4) is Verdict.NOT_REPRODUCED
    assert verdicts.positive(Statistic(1, 0.1, 2, 0, 3, 9)) is Verdict.REPRODUCED
    assert verdicts.positive(Statistic(1, -0.1, 2, 0, 3, 9)) is Verdict.PARTLY
    assert verdicts.positive(Statistic(1, NAN, NAN, 1, 1, 1)) is Verdict.PARTLY  # one seed proves nothing
    assert verdicts.positive(Statistic(-1, -2, -0.1, -3, 0, 9)) is Verdict.NOT_REPRODUCED
    parts = (Verdict.REPRODUCED, Verdict.NOT_TESTED, Verdict.NOT_REPRODUCED)
    assert verdicts.together(parts) is Verdict.PARTLY
    assert verdicts.together(parts[:2]) is Verdict.REPRODUCED
    assert verdicts.together(()) is Verdict.NOT_TESTED


@pytest.mark.parametrize(
    ("id", "verdict"),
    [
        ("order-data-1", Verdict.REPRODUCED),
        ("order-data-2", Verdict.REPRODUCED),
        ("order-data-4", Verdict.REPRODUCED),
        ("window-ratio-IBRKF", Verdict.REPRODUCED),
        ("window-state-fault-3", Verdict.REPRODUCED),
        ("window-growth", Verdict.REPRODUCED),
        ("velocity-spikes", Verdict.REPRODUCED),
        ("velocity-damped", Verdict.REPRODUCED),
        ("figure-7", Verdict.REPRODUCED),
        ("figure-8", Verdict.PARTLY),  # helps within 1.5 m, never harms beyond
        ("wls-drop", Verdict.NOT_REPRODUCED),
        ("adop-beyond", Verdict.NOT_REPRODUCED),
        ("sees-wrong-fixes", Verdict.NOT_REPRODUCED),
        ("literal-noise", Verdict.NOT_REPRODUCED),
        ("disjoint-orders", Verdict.PARTLY),  # too few seeds
        ("robust-better", Verdict.REPRODUCED),
        ("no-lower-4", Verdict.REPRODUCED),
        ("wls-drop-possible", Verdict.REPRODUCED),
        ("adop-never-worse", Verdict.REPRODUCED),
        ("biased-ins", Verdict.REPRODUCED),
        ("velocity-at-changes", Verdict.REPRODUCED),
        ("literal-reported", Verdict.REPRODUCED),
    ],
)
def test_claims_follow_from_what_was_put_in(summary: Summary, id: str, verdict: Verdict) -> None:
    claim = _claim(summary, id)
    assert claim.verdict is verdict, claim


def test_claims_turn_with_the_numbers(summary: Summary) -> None:
    def changed(metric: str, algorithms: tuple[str, ...], data: int, value: float) -> Summary:
        flat = Statistic(value, value, value, value, value, N_SEEDS)
        cells = {Cell(DEFAULT, data, algorithm) for algorithm in algorithms}
        rows = [replace(r, statistics={**r.statistics, metric: flat}) if r.cell in cells else r for r in summary.rows]
        return replace(summary, rows=tuple(rows))

    assert _claim(changed("p_se", ("3a", "3b"), 1, 94.4), "table-2-IEKF-1").verdict is Verdict.REPRODUCED
    assert _claim(changed("p_se", ("3a", "3b"), 1, 40.0), "table-2-IEKF-1").verdict is Verdict.NOT_REPRODUCED
    assert _claim(changed("fault_ratio_median@800", ("4b",), 2, 2.0), "window-ratio-IBRKF").verdict is Verdict.PARTLY
    assert _claim(changed("adapted_wrong", ("1b",), 1, 80.0), "sees-wrong-fixes").verdict is Verdict.REPRODUCED
    good = changed("baseline_rms", (GRAPH,), 4, 0.011)
    assert _claim(changed("baseline_rms", (GRAPH,), 4, 0.2), "graph-4").verdict is Verdict.PARTLY
    assert _claim(good, "graph-4").verdict is Verdict.REPRODUCED and _claim(good, "graph-4").word == "met"
    swapped = [replace(d, difference=verdicts.negated(d.difference)) for d in summary.differences]
    assert _claim(replace(summary, differences=tuple(swapped)), "order-data-3").verdict is Verdict.NOT_REPRODUCED
    assert _claim(replace(summary, sweep={}), "figure-7").verdict is Verdict.NOT_TESTED
    worse = [
        replace(c, mean=((-9.0,) * 5,), upper=((-8.0,) * 5,)) if c.name == "success_bias_gain" else c for c in summary.curves
    ]
    assert _claim(replace(summary, curves=tuple(worse)), "biased-ins").verdict is Verdict.PARTLY  # no matter of the bias


def _without_gain(summary: Summary, *pairs: tuple[str, str], value: float = 0.0) -> Summary:
    """The summary with the same success rate of the algorithms of each pair, or another difference."""
    even = Statistic(value, value, value, value, value, N_SEEDS)
    rows = tuple(
        replace(d, difference=even) if d.metric == "p_se" and (d.first.algorithm, d.second.algorithm) in pairs else d
        for d in summary.differences
    )
    return replace(summary, differences=rows)


def test_claims_about_schemes_are_judged_beside_each_main_filter(summary: Summary) -> None:
    both = _claim(summary, "order-data-2")
    assert both.verdict is Verdict.REPRODUCED and "SKF:" in both.ours and "AKF:" in both.ours
    one = _claim(_without_gain(summary, ("3a", "4a")), "order-data-2")
    assert one.verdict is Verdict.PARTLY and one.ours.startswith("SKF: 0 points (0 to 0); AKF: ")
    assert one.evidence.startswith("With the SKF not reproduced, with the AKF reproduced. ")
    check = _claim(_without_gain(summary, ("3b", "4b")), "robust-better")
    assert check.word == "partly met" and check.evidence.startswith("With the SKF met, with the AKF not met. ")
    neither = _claim(_without_gain(summary, ("3a", "4a"), ("3b", "4b")), "order-data-2")
    assert neither.verdict is Verdict.NOT_REPRODUCED and neither.ours == "SKF and AKF: 0 points (0 to 0)"
    alone = _claim(summarise(made_up(N_SEEDS, (2,), (DEFAULT,), ("3b", "4b"))), "order-data-2")
    assert alone.verdict is Verdict.PARTLY and alone.evidence.endswith("Not run with the SKF.")


def test_no_lower_is_not_higher(summary: Summary) -> None:
    even = _without_gain(summary, ("3a", "4a"), ("3b", "4b"), ("4a", "5a"), ("4b", "5b"))
    assert _claim(even, "no-lower-3").verdict is Verdict.REPRODUCED
    assert _claim(even, "order-data-3").verdict is Verdict.NOT_REPRODUCED
    assert _claim(_without_gain(summary, ("4b", "5b"), value=-1.0), "no-lower-3").verdict is Verdict.PARTLY
    assert verdicts.at_least_zero(Statistic(0.5, -0.1, 1, -1, 2, 9)) is Verdict.PARTLY
    assert verdicts.at_least_zero(Statistic(-1, NAN, NAN, -1, -1, 1)) is Verdict.NOT_REPRODUCED


def test_advantages_of_robust_schemes_follow_from_the_numbers(summary: Summary) -> None:
    with_both = aar_claims.robust_advantages(summary)
    assert "Data 2: IBRKF succeeds more often than IEKF beside both main filters" in with_both[0]
    standard = _without_gain(summary, ("3a", "4a"), ("4a", "5a"))
    only, *each = aar_claims.robust_advantages(standard)
    assert only.startswith("The robust schemes have an advantage only beside the AKF (Data 2")
    assert len(each) == 5 and "only beside the AKF (SKF 0 points (0 to 0), AKF " in each[0]
    none = aar_claims.robust_advantages(_without_gain(standard, ("3b", "4b"), ("4b", "5b")))
    assert none[0] == "The robust schemes have an advantage beside neither main filter."
    assert aar_claims.robust_advantages(summarise(made_up(2, (2,), (DEFAULT,), ("3b", "4b"), 300))) == []


def test_every_claim_has_its_own_name_and_says_what_is_missing() -> None:
    found = claims(summarise(made_up(2, (1,), (DEFAULT,), ("1a", "2a"), 400)))
    assert len({claim.id for claim in found}) == len(found)
    assert all(claim.evidence for claim in found)
    missing = [claim for claim in found if claim.verdict is Verdict.NOT_TESTED]
    assert missing and all(claim.evidence.startswith("Not run: ") for claim in missing)
    assert [c.id for c in found if c.id.startswith("table-2") and c.verdict is not Verdict.NOT_TESTED] == [
        "table-2-WLS-1",
        "table-2-EKF-1",
    ]


def test_numbers_in_words() -> None:
    assert verdicts.plain(-0.5) == "−0.5" and verdicts.plain(12345.0) == "12300" and verdicts.plain(NAN) == "–"
    assert verdicts.shown(Statistic(94.44, 93, 95.96, 90, 97, 9), "%", ".1f") == "94.4 % (93.0 to 96.0)"
    assert verdicts.shown(Statistic(0.05, NAN, NAN, 0.05, 0.05, 1), "cm", scale=100) == "5 cm"


# record


def _page_of(content: Path) -> str:
    return aar_record.markdown(json.loads(content.read_text(encoding="utf-8")))


def test_summary_survives_json(summary: Summary) -> None:
    text = json_text(to_json(summary))
    back = from_json(json.loads(text))
    assert to_json(back) == to_json(summary)
    assert [repr(claim) for claim in claims(back)] == [repr(claim) for claim in claims(summary)]
    assert len(text) < 300_000
    with pytest.raises(InputError, match="format 99"):
        from_json({"format": 99})


def test_record_is_made_again_from_its_json(summary: Summary, tmp_path: Path) -> None:
    parameters = {"process noise σ_a [m/s²/√s]": 1.0, "ratio threshold": 3, "start times": [0, 1]}
    content, page = aar_record.write_record(summary, tmp_path / "new", parameters, "relnav study aar --trials 6")
    assert _page_of(content) == page.read_text(encoding="utf-8")
    text = page.read_text(encoding="utf-8")
    for part in (
        "relnav study aar --trials 6",
        "| ratio threshold | 3 |",
        "## Success rate P_SE [%]",
        "literal-noise",
        "start 4",
        "after Wu and others (2022)",
        "## Readings and departures",
        "## Further checks",
        "start, Data 1: WLS-SKF (1a) 5",
        "known-float, Data 1: not run.",
    ):
        assert part in text
    assert not re.search(r"as published|acceptance|spec|\bE\d+\b|erratum|check-\d", text, re.IGNORECASE)
    for lines in text.split("\n\n"):
        columns = {line.replace("\\|", "").count("|") for line in lines.splitlines() if line.startswith("|")}
        assert len(columns) <= 1


def test_record_of_nothing_can_be_written(tmp_path: Path) -> None:
    content, page = aar_record.write_record(Summary(), tmp_path, {}, "relnav study aar")
    assert "not tested" in page.read_text(encoding="utf-8") and _page_of(content)
    assert len(aar_record.write_table(Summary(), tmp_path)) == 2


def test_table_for_other_programs(summary: Summary, tmp_path: Path) -> None:
    csv, parquet = aar_record.write_table(summary, tmp_path)
    found = pq.read_table(parquet).to_pylist()
    assert len(found) == sum(len(row.statistics) for row in summary.rows) == len(csv.read_text().splitlines()) - 1
    (one,) = [
        r for r in found if (r["variant"], r["data"], r["start"], r["algorithm"], r["metric"]) == (DEFAULT, 4, 0, "5b", "p_se")
    ]
    wanted = summary.statistic("p_se", "5b", 4)
    assert wanted is not None and (one["mean"], one["unit"], one["seeds"]) == (wanted.value, "%", N_SEEDS)


def test_page_of_the_documentation_is_that_of_its_results() -> None:
    folder = ROOT / "docs" / "studies"
    if not (folder / aar_record.JSON_NAME).exists():
        pytest.skip("docs/studies holds no results of the refuelling study")
    assert (folder / aar_record.PAGE_NAME).read_text(encoding="utf-8") == _page_of(folder / aar_record.JSON_NAME)
    assert (folder / aar_record.JSON_NAME).stat().st_size < 350_000
