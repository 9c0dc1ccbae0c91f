"""What kind of outlier a measurement is: multipath, a reflection without direct sight, a slip, or a gross error by itself.

Outliers of one source, label and kind that follow each other make a run: at most one good row, and no gap in time, lies
between two of them. A run of at least `LASTING` rows lasts; errors that come by chance rarely do.

    slip        phases that last: an ambiguity that jumped or is held at a wrong integer
    nlos        codes and ranges that last with one sign, seen low or weakly: the direct way is blocked, and the way by a
                reflector is longer. The sign is positive; in differences negative means the reference's
    multipath   other codes and ranges that last: direct and reflected signals together err to both sides
    gross       anything else

Source: Groves and Jiang (2013), Height aiding, C/N0 weighting and consistency checking for GNSS NLOS and multipath
mitigation in urban areas, for signal strength and elevation as signs of blocked signals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorgraph.solution import OUTLIER_CLASSES, ResidualTable
from factorgraph.types import Array, BoolArray, IntArray

GOOD, GROSS, MULTIPATH, NLOS, SLIP = range(len(OUTLIER_CLASSES))
LASTING = 5  # rows
ONE_SIGNED = 0.9  # of the rows of a run
LOW_RAD = np.deg2rad(45.0)
WEAK_DBHZ = 35.0  # signals in plain sight are stronger
GAP_STEPS = 2.5  # median steps of a series that are no gap
WORDS = {GROSS: "gross", MULTIPATH: "multipath", NLOS: "NLOS", SLIP: "slip suspected"}


@dataclass(frozen=True, slots=True)
class OutlierRun:
    """Outliers of one satellite and signal, or whatever a label is, that belong together."""

    kind: str
    source: str
    label: str
    start_s: float
    end_s: float
    outlier_class: int
    n: int
    mean: float  # residual, SI; of gross ones over the whole flight the mean size
    largest: float  # size

    @property
    def words(self) -> str:
        return WORDS[self.outlier_class]


def classify(
    kinds: Sequence[str],
    kind: IntArray,
    series: IntArray,
    t_s: Array,
    residual: Array,
    outlier: BoolArray,
    elevation_rad: Array,
    cn0_dbhz: Array,
    differenced: BoolArray,
) -> IntArray:
    """Index (n,) into OUTLIER_CLASSES of every row; 0 where it is no outlier.

    `series` (n,) numbers source and label together; `differenced` rows may err to the negative side, too. Elevation and C/N0
    are NaN where they are not known.
    """
    found = np.where(outlier, GROSS, GOOD)
    rows, run = _runs(kind, series, t_s, outlier)
    if not len(rows):
        return found
    count = np.bincount(run)
    mean_sign = np.bincount(run, np.sign(residual[rows])) / count
    one_signed = np.abs(mean_sign) >= 2 * ONE_SIGNED - 1
    one_signed &= (mean_sign > 0) | (np.bincount(run, differenced[rows]) > 0)
    hidden = ~(elevation_rad[rows] >= LOW_RAD) | (cn0_dbhz[rows] < WEAK_DBHZ)
    mostly_hidden = np.bincount(run, hidden) >= 0.5 * count
    delayed = np.isin(kind[rows], [i for i, name in enumerate(kinds) if name in ("code", "range")])
    phases = np.isin(kind[rows], [i for i, name in enumerate(kinds) if name == "phase"])
    lasts = (count >= LASTING)[run]
    reflected = np.where((one_signed & mostly_hidden)[run], NLOS, MULTIPATH)
    found[rows] = np.select([lasts & phases, lasts & delayed], [SLIP, reflected], GROSS)
    return found


def _runs(kind: IntArray, series: IntArray, t_s: Array, outlier: BoolArray) -> tuple[IntArray, IntArray]:
    """Rows of the outliers, ordered by kind, series and time, and the number of the run of each."""
    if not np.any(outlier):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    order = np.lexsort((t_s, series, kind))
    changes = (np.diff(kind[order]) != 0) | (np.diff(series[order]) != 0)
    number = np.concatenate([[0], np.cumsum(changes)])
    # a series' own step: rows of slow and fast sensors stand side by side
    usual_s = np.array(
        [np.median(np.diff(part)) if len(part) > 1 else 0.0 for part in np.split(t_s[order], np.flatnonzero(changes) + 1)]
    )
    at = np.flatnonzero(outlier[order])
    gap = np.diff(t_s[order[at]]) > GAP_STEPS * usual_s[number[at[1:]]]
    new = (np.diff(number[at]) != 0) | (np.diff(at) > 2) | gap
    return order[at], np.concatenate([[0], np.cumsum(new)]).astype(np.int64)


def outlier_runs(table: ResidualTable) -> list[OutlierRun]:
    """The outliers of a solution: those that last run by run, gross ones in one entry for each series; the largest effects first.

    A run's size is its number of rows times its mean residual over sigma.
    """
    flagged = table.outlier_class > GOOD
    series = table.source_index * max(len(table.label), 1) + table.label_index
    rows, run = _runs(table.kind_index, series, table.t_s, flagged)
    of_class = table.outlier_class[rows]
    lasting = of_class != GROSS
    # gross ones: numbered by kind and series after all runs
    gross = np.unique(table.kind_index[rows] * (int(series.max(initial=0)) + 1) + series[rows], return_inverse=True)[1]
    number = np.where(lasting, run, int(run.max(initial=0)) + 1 + gross) if len(rows) else run
    found = []
    order = np.argsort(number, kind="stable")
    rows, number = rows[order], number[order]
    for part in np.split(rows, np.flatnonzero(np.diff(number)) + 1) if len(rows) else []:
        found.append((_described(table, part), float(np.sum(np.abs(table.residual[part]) / table.sigma[part]))))
    return [entry for entry, _ in sorted(found, key=lambda pair: -pair[1])]


def _described(table: ResidualTable, rows: IntArray) -> OutlierRun:
    residual, outlier_class = table.residual[rows], int(table.outlier_class[rows[0]])
    return OutlierRun(
        kind=table.kind[table.kind_index[rows[0]]],
        source=table.source[table.source_index[rows[0]]],
        label=table.label[table.label_index[rows[0]]],
        start_s=float(table.t_s[rows].min()),
        end_s=float(table.t_s[rows].max()),
        outlier_class=outlier_class,
        n=len(rows),
        mean=float(np.mean(np.abs(residual) if outlier_class == GROSS else residual)),
        largest=float(np.abs(residual).max()),
    )


def class_counts(table: ResidualTable) -> dict[str, int]:
    """Outliers of each class that occurs."""
    counts = np.bincount(table.outlier_class, minlength=len(OUTLIER_CLASSES))
    return {WORDS[i]: int(counts[i]) for i in WORDS if counts[i]}
