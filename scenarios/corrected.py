"""Any recursive filter with a search that corrects it: `getattr(corrected, "eskf-tdo")`, or `create` with other settings.

A stage is judged by the normalised innovation squared of the rows that a filter judges (`swarm.judgement`). Where it does not
fit, the state is decided anew as the least of

    e'e + d' inv(P) d,   e = z - H d whitened,

over deviations d from the prediction (O3), in coordinates whitened by the posterior of the states that rows see; the others
follow. Rows are as the filter linearised them. Of a filter that takes its rows as they are, the posterior is where that is least,
and a search can at best return to it; one that weighs rows or noise (huber, rackf, sage-husa, iae, rae, forgetting) is taken back
to the noise as stated. Where a covariance is not sound, the posterior stays.

Updates of the relative filter are judged and corrected as they are, with distances and the constants of ranges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec

import numpy as np

from factorgraph.errors import InputError
from factorgraph.filters.correctors import Case, Searched
from factorgraph.filters.methods import FILTERS
from factorgraph.filters.recursive import Recursive
from factorgraph.filters.relative import method as relative
from factorgraph.filters.relative.filtering import Update
from factorgraph.filters.relative.method import RelativeFilter
from factorgraph.registry import RECURSIVE
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.methods import CORRECTED, RELATIVE, SMOOTHED
from swarm.corrector import Corrected, Corrector, CorrectorSettings
from swarm.judgement import Rule, judge
from swarm.snapshot import Snapshot

SETTINGS = CorrectorSettings(coordinates="whitened")
SEED = 0  # of every run: a flight has one solution


class Correction:
    """Judges and corrects the stages of one run; `triggered` counts them."""

    def __init__(self, search: str, settings: CorrectorSettings = SETTINGS) -> None:
        self.rule = settings.rule
        self.corrector = Corrector(replace(settings, rule=Rule("always")), search)
        self.rng, self.triggered = np.random.default_rng(SEED), 0

    def __call__(self, case: Case) -> tuple[Array, Array] | None:
        """State and covariance of a stage that was corrected, none where it fits."""
        if not self._doubted(case):
            return None
        self.triggered += 1
        try:
            found = self.corrector(_snapshot(case, np.ones(len(case.e), np.bool_), None), self.rng)
        except np.linalg.LinAlgError:
            return None
        return found.x, found.P

    def _doubted(self, case: Case) -> bool:
        if self.rule.form in ("always", "never"):
            return self.rule.form == "always" and bool(case.H.any())
        return case.dof > 0 and judge(self.rule, _snapshot(case, case.judged, case.dof)).triggered


def _snapshot(case: Case, rows: BoolArray, dof: float | None) -> Snapshot:
    e, H = case.e[rows], case.H[rows]
    return Snapshot(np.zeros(len(case.x_post)), case.P_prior, case.x_post, case.P_post, e, np.eye(len(e)), H, dof=dof)


@dataclass(frozen=True, slots=True)
class RelativeCorrection:
    """Judges and corrects the updates of a relative filter, all draws from one generator.

    A reference that stands on the ground has states without variance: they are left as they are. Constants of ranges are states
    like others.
    """

    corrector: Corrector
    rng: np.random.Generator

    def __call__(self, update: Update) -> Corrected:
        free = np.flatnonzero(np.diag(update.P_prior) > 0.0)
        found = self.corrector(relative_snapshot(update, free), self.rng)
        if not found.triggered:
            return replace(found, x=update.x_post, P=update.P_post)
        x, P = update.x_post.copy(), update.P_post.copy()
        x[free], P[np.ix_(free, free)] = found.x, found.P
        return replace(found, x=x, P=P)


def relative_snapshot(update: Update, free: IntArray | None = None) -> Snapshot:
    """An update of the relative filter, of the states `free` where only some have variance; the others are as predicted.

    Biases b of distances are exact. Errors k of their scale are of first order: with those predicted, x_0 and k_0,

        (scale + k) |D x + d| + b = (scale + k_0) |D x + d| + (k - k_0) |D x_0 + d| + b

    but for (k - k_0) times the change of the distance.
    """
    n, rows, x = len(update.x_prior), update.rows, update.x_prior
    free = np.arange(n) if free is None else free
    fixed, square = np.setdiff1d(np.arange(n), free), np.ix_(free, free)
    H, z, D = rows.H.copy(), rows.z.copy(), rows.norm_D if len(rows.norm_rows) else np.zeros((0, 3, n))
    scaled = np.flatnonzero(rows.norm_state >= 0)
    row, k = rows.norm_rows[scaled], rows.norm_state[scaled]
    size = np.linalg.norm(D @ x + rows.norm_d, axis=1)[scaled]
    H[row, k] += size
    z[row] += size * x[k]
    return Snapshot(
        x[free], update.P_prior[square], update.x_post[free], update.P_post[square], z - H[:, fixed] @ x[fixed], rows.R,
        update.H[:, free], rows.norm_rows, D[:, :, free], rows.norm_d + D[:, :, fixed] @ x[fixed], rows.scales(x),
        H[rows.norm_rows][:, free],
    )  # fmt: skip


def create(name: str, settings: CorrectorSettings = SETTINGS, integers: bool | None = None) -> Recursive | RelativeFilter:
    """A method of the family FILTER-SEARCH; `integers` as in `Recursive`.

    Raises KeyError for an unknown filter, InputError where the search needs a package that is not installed.
    """
    if name.startswith(f"{RELATIVE}-"):
        search = _at_hand(name.removeprefix(f"{RELATIVE}-"))
        return replace(
            relative.RELATIVE,
            name=name,
            summary=f"{relative.RELATIVE.summary}, corrected by {search}",
            correct=lambda: RelativeCorrection(Corrector(settings, search), np.random.default_rng(SEED)),
        )
    alone = name.removesuffix(SMOOTHED)
    plain = next((f for f in sorted(FILTERS, key=len, reverse=True) if alone.startswith(f"{f}-")), alone)
    method, search = FILTERS[plain], _at_hand(alone[len(plain) + 1 :])
    corrected = replace(method, corrector=lambda: Searched(method.corrector(), Correction(search, settings)))
    return Recursive(name, f"{RECURSIVE[plain]}, corrected by {search}", corrected, name.endswith(SMOOTHED), integers)


def _at_hand(search: str) -> str:
    """The search, where what it needs is installed."""
    if search == "cma-es" and find_spec("cmaes") is None:
        raise InputError('the search cma-es needs cmaes, which is not installed; try: pip install "relnav[optimisers]"')
    return search


def __getattr__(name: str) -> Recursive | RelativeFilter:
    if name not in CORRECTED.names:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return create(name)
