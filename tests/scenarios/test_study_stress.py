"""The stress study: its trials on one short seed, its summary on made-up results, its options."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from factorgraph.errors import InputError
from scenarios.studies import catalogue, store, stress, stress_record
from scenarios.studies.stress import CASES, FRACTIONS, trial
from scenarios.studies.study import Job, Results


def options(**changes: object) -> argparse.Namespace:
    return argparse.Namespace(**({"cases": list(CASES), "trials": None, "quick": True, "seed": 1} | changes))


@pytest.mark.slow
def test_outliers_are_found_and_change_little() -> None:
    found = trial("outliers", 3, quick=True)
    assert found["outliers"] > 100
    assert found["outliers_found"] >= 0.97 * found["outliers"] and found["good_refused"] <= 0.03 * found["good"]
    assert found["faulty/rmse_m"] < 1.1 * found["clean/rmse_m"] and found["faulty/fixed"] == 1


@pytest.mark.slow
def test_no_slip_stays_inside_an_arc() -> None:
    found = trial("slips", 3, quick=True)
    assert found["slips"] > 3 and found["slips_missed"] == 0 and found["faulty/wrong"] == 0


@pytest.mark.slow
def test_headings_declared_at_random_are_found() -> None:
    found = trial("heading", 3, quick=True)
    assert found["starts"] == 2 and found["starts_missed"] == 0


def test_every_case_has_jobs_and_unknown_ones_are_named() -> None:
    study = catalogue.create("stress")
    jobs = study.jobs(options())
    assert len(jobs) == 2 * len(CASES) and {job.parameters["case"] for job in jobs} == set(CASES)
    with pytest.raises(InputError, match="no case outlier; did you mean outliers"):
        study.jobs(options(cases=["outlier"]))


def made_up(folder: Path, ratio: float) -> Results[Job]:
    """Four seeds of one case whose faulty error is `ratio` times the other, with NEES as expected."""
    files = {}
    rng = np.random.default_rng(0)
    for seed in range(4):
        arrays = {f"{k}/{name}": np.array(x) for k in ("clean", "faulty") for name, x in (("fixed", 1.0), ("wrong", 0.0))}
        arrays |= {"clean/rmse_m": np.array(0.004 + 1e-4 * seed), "faulty/rmse_m": np.array(ratio * (0.004 + 1e-4 * seed))}
        arrays |= {f"{k}/nees": rng.chisquare(3, len(FRACTIONS)) for k in ("clean", "faulty")}
        arrays |= {"slips": np.array(10.0), "slips_missed": np.array(0.0)}
        job = Job(f"slips-{seed}", {"case": "slips", "seed": seed})
        files[job] = folder / f"{job.key}.npz"
        files[job].write_bytes(store.pack(arrays, store.header("stress", job.parameters)))
    return Results(files)


def test_the_summary_says_what_the_trials_say(tmp_path: Path) -> None:
    (summary,) = stress_record.summarise(made_up(tmp_path, 1.05))
    assert summary.name == "slips" and summary.seeds == 4
    assert summary.ratio.value == pytest.approx(1.05) and summary.clean_mm.value == pytest.approx(4.15)
    assert summary.found == "slips left inside kept arcs: 0 of 40"


def test_the_record_is_written_thrice(tmp_path: Path) -> None:
    results = made_up(tmp_path, 1.05)
    outcome = stress_record.write(results, tmp_path, options())
    assert "slips: RMSE ratio 1.050" in outcome.lines[0]
    tree = json.loads((tmp_path / "stress.json").read_text(encoding="utf-8"))
    assert tree["cases"]["slips"]["seeds"] == 4 and set(tree["parameters"]) == set(stress.parameters())
    page = (tmp_path / "stress.md").read_text(encoding="utf-8")
    assert "| slips | 4 |" in page and "slips left inside kept arcs: 0 of 40" in page
    assert "1.050" in (tmp_path / "report.html").read_text(encoding="utf-8")
