"""Outliers by what they look like: runs, signs, strength; and how a solution lists them."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph.models.outliers import GOOD, GROSS, MULTIPATH, NLOS, SLIP, class_counts, classify, outlier_runs
from factorgraph.solution import OUTLIER_CLASSES, ResidualTable
from factorgraph.types import Array, BoolArray, IntArray

KINDS = ("code", "phase", "doppler", "range")
N = 60


def classes(
    residual: Array,
    outlier: BoolArray,
    kind: str = "code",
    elevation_deg: float = 20.0,
    cn0_dbhz: float = 45.0,
    differenced: bool = False,
    t_s: Array | None = None,
) -> IntArray:
    """Of one series, a row a second unless told otherwise."""
    n = len(residual)
    return classify(
        KINDS,
        np.full(n, KINDS.index(kind)),
        np.zeros(n, np.int64),
        np.arange(n, dtype=float) if t_s is None else t_s,
        residual,
        outlier,
        np.full(n, np.deg2rad(elevation_deg)),
        np.full(n, cn0_dbhz),
        np.full(n, differenced),
    )


def lasting(sign: float | Array, first: int = 20, count: int = 10) -> tuple[Array, BoolArray]:
    outlier = np.zeros(N, bool)
    outlier[first : first + count] = True
    return np.where(outlier, 12.0 * np.resize(sign, N), 0.3), outlier


@pytest.mark.parametrize(
    ("kind", "sign", "elevation_deg", "cn0_dbhz", "differenced", "expected"),
    [
        ("code", 1.0, 20.0, 45.0, False, NLOS),
        ("code", 1.0, 70.0, 30.0, False, NLOS),  # high but weak
        ("code", 1.0, 70.0, 45.0, False, MULTIPATH),  # high and strong: direct sight
        ("code", -1.0, 20.0, 45.0, False, MULTIPATH),  # a longer way is never shorter
        ("code", -1.0, 20.0, 45.0, True, NLOS),  # the reference's
        ("code", [1.0, -1.0], 20.0, 45.0, False, MULTIPATH),
        ("range", 1.0, np.nan, np.nan, False, NLOS),
        ("range", -1.0, np.nan, np.nan, False, MULTIPATH),
        ("phase", 1.0, 20.0, 45.0, True, SLIP),
        ("phase", [1.0, -1.0], 70.0, 45.0, True, SLIP),
        ("doppler", 1.0, 20.0, 45.0, False, GROSS),
    ],
)
def test_errors_that_last(
    kind: str, sign: float, elevation_deg: float, cn0_dbhz: float, differenced: bool, expected: int
) -> None:
    residual, outlier = lasting(np.asarray(sign))
    found = classes(residual, outlier, kind, elevation_deg, cn0_dbhz, differenced)
    np.testing.assert_array_equal(found, np.where(outlier, expected, GOOD))


def test_single_rows_are_gross() -> None:
    residual, outlier = lasting(1.0, count=4)
    assert set(classes(residual, outlier)[outlier]) == {GROSS}
    spread = np.zeros(N, bool)
    spread[::3] = True  # two good rows between
    assert set(classes(np.full(N, 9.0), spread)[spread]) == {GROSS}


def test_one_good_row_does_not_end_a_run_but_a_gap_does() -> None:
    outlier = np.isin(np.arange(N), [10, 11, 13, 15, 16])
    assert set(classes(np.full(N, 9.0), outlier)[outlier]) == {NLOS}
    t = np.arange(N) + np.where(np.arange(N) >= 12, 30.0, 0.0)
    assert set(classes(np.full(N, 9.0), outlier, t_s=t)[outlier]) == {GROSS}


def test_runs_belong_to_one_series_whatever_the_order() -> None:
    """Two satellites by turns, of which one has the same outliers as before and the other none."""
    residual, outlier = lasting(1.0)
    rng = np.random.default_rng(3)
    shuffled = rng.permutation(2 * N)
    series = np.repeat([0, 1], N)[shuffled]
    bad = np.concatenate([outlier, np.zeros(N, bool)])[shuffled]
    found = classify(
        KINDS,
        np.zeros(2 * N, np.int64),
        series,
        np.tile(np.arange(float(N)), 2)[shuffled],
        np.concatenate([residual, np.zeros(N)])[shuffled],
        bad,
        np.full(2 * N, 0.3),
        np.full(2 * N, np.nan),
        np.zeros(2 * N, bool),
    )
    np.testing.assert_array_equal(found, np.where(bad, NLOS, GOOD))


def test_errors_by_chance_rarely_look_like_reflections() -> None:
    """Every tenth code is off by chance: fewer than one in fifty of them may be called anything but gross."""
    rng = np.random.default_rng(4)
    outlier = rng.random(20_000) < 0.1
    residual = np.where(outlier, rng.choice([-20.0, 20.0], 20_000), 0.3)
    found = classes(residual, outlier)
    assert np.mean(found[outlier] != GROSS) < 0.02 and not np.any(found[~outlier])


def test_no_outliers_and_no_rows() -> None:
    assert not np.any(classes(np.zeros(N), np.zeros(N, bool)))
    assert classes(np.zeros(0), np.zeros(0, bool)).shape == (0,)


def _table() -> ResidualTable:
    """G12 blocked from 20 to 29 s and twice grossly wrong, G24 good."""
    residual, outlier = lasting(1.0)
    residual[[45, 52]], outlier[[45, 52]] = [-30.0, 20.0], True
    both, n = np.concatenate([outlier, np.zeros(N, bool)]), 2 * N
    return ResidualTable(
        kind=KINDS,
        source=("car G1C",),
        label=("G12", "G24"),
        kind_index=np.zeros(n, np.int64),
        source_index=np.zeros(n, np.int64),
        label_index=np.repeat([0, 1], N),
        t_s=np.tile(np.arange(float(N)), 2),
        residual=np.concatenate([residual, np.zeros(N)]),
        sigma=np.full(n, 2.0),
        weight=np.where(both, 0.1, 1.0),
        outlier=both,
        azimuth_rad=np.full(n, 1.0),
        elevation_rad=np.full(n, 0.3),
        outlier_class=np.concatenate([classes(residual, outlier), np.zeros(N, np.int64)]),
    )


def test_what_belongs_together_is_one_line() -> None:
    run, gross = outlier_runs(_table())
    assert (run.label, run.words, run.n, run.start_s, run.end_s) == ("G12", "NLOS", 10, 20.0, 29.0)
    assert run.mean == pytest.approx(12.0) and run.source == "car G1C"
    assert (gross.words, gross.n, gross.start_s, gross.end_s, gross.mean, gross.largest) == ("gross", 2, 45.0, 52.0, 25.0, 30.0)
    assert class_counts(_table()) == {"gross": 2, "NLOS": 10}


def test_tables_of_other_methods_have_classes_too() -> None:
    """Outliers that were not classified are gross; nothing is known of their signals' strength."""
    outlier = np.array([True, False])
    table = ResidualTable(t_s=np.zeros(2), residual=np.ones(2), sigma=np.ones(2), weight=np.ones(2), outlier=outlier)
    assert [OUTLIER_CLASSES[i] for i in table.outlier_class] == ["gross", ""] and np.all(np.isnan(table.cn0_dbhz))
    assert outlier_runs(ResidualTable()) == [] and class_counts(ResidualTable()) == {}
