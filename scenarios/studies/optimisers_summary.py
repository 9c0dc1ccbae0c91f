"""What the study of the optimisers found: spreads, success, ranks and tests, from the stored runs alone.

Errors are compared by their decimal logarithm, errors below `Problem.even` taken as that. The unit of the paired tests is
a seed: of a kind of problems the mean of these logarithms over its problems, so that they speak of these problems and all
their placements. The unit of the ranks is a problem with its median over the seeds; in navigation, where every seed is
another snapshot, it is a snapshot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factorgraph.consistency import Interval, wilson
from factorgraph.types import Array
from scenarios.metrics_ranks import LEVEL, PairedTest, Ranking, Spread, holm, paired_test, ranking, spread
from scenarios.studies.optimisers import KINDS
from scenarios.studies.study import Job, Results

MOSTLY = 0.9  # share of solved runs from which on it matters how soon
SUBJECT = "tdo"  # the method that is said to be better
CONTRASTS = (("origin", "moved"), ("normalised", "raw"), ("normalised", "whitened"))


@dataclass(frozen=True, eq=False)  # no slots: cached properties need a place
class Problem:
    """All runs of one problem, M methods on S seeds."""

    kind: str
    name: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    max_evals: int
    error: Array  # (M, S)
    evals: Array  # (M, S)
    hit: Array  # (M, S) evaluations until solved, NaN where not
    runtime_s: Array  # (M, S)
    history: Array  # (M, S, G)
    solved: float
    even: float

    @cached_property
    def score(self) -> Array:
        """Logarithm (M, S) of what the error is taken as."""
        return np.asarray(np.log10(np.maximum(self.error, self.even)))

    @cached_property
    def effort(self) -> Array:
        """Logarithm (M, S) of the evaluations until it was solved; the whole budget where it was not."""
        return np.asarray(np.log10(np.where(np.isfinite(self.hit), self.hit, self.max_evals)))

    def spread(self, method: str) -> Spread:
        """Quartiles of a method's error."""
        return spread(self.error[self.methods.index(method)])

    def success(self, method: str) -> Interval:
        """Share of runs that solved it, with Wilson's interval."""
        hit = self.hit[self.methods.index(method)]
        return wilson(int(np.isfinite(hit).sum()), len(hit))

    def expected_evals(self, method: str) -> float:
        """Evaluations spent by all runs for each one that solved it; infinite where none did."""
        i = self.methods.index(method)
        hit = self.hit[i]
        n = int(np.isfinite(hit).sum())
        return float(np.where(np.isfinite(hit), hit, self.evals[i]).sum() / n) if n else float("inf")

    @cached_property
    def curves(self) -> Array:
        """Quartiles over the seeds of the error against evaluations (3, M, G), not below `even`."""
        return np.asarray(np.quantile(np.maximum(self.history, self.even), (0.25, 0.5, 0.75), axis=1))


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether one method is better than another on a kind of problems."""

    kind: str
    first: str
    second: str
    test: PairedTest  # of mean logarithms of error or effort, second less first
    p: float  # adjusted for the family of all verdicts
    n_better: int  # problems on which the first is better by a test of its own, adjusted within the kind
    n_worse: int
    n_problems: int

    @property
    def word(self) -> str:
        if self.p >= LEVEL or self.test.sign == 0:
            return "not significant"
        return "yes" if self.test.sign > 0 else "no, worse"


@dataclass(frozen=True, slots=True)
class Contrast:
    """One method on the same problems put in two ways."""

    first: str  # kinds
    second: str
    method: str
    test: PairedTest  # of mean logarithms, second less first
    p: float  # adjusted for all methods and contrasts

    @property
    def word(self) -> str:
        if self.p >= LEVEL or self.test.sign == 0:
            return "no difference"
        return f"better: {KINDS[self.first if self.test.sign > 0 else self.second].title}"


@dataclass(frozen=True, slots=True)
class Summary:
    """Everything the record and the page are made of."""

    problems: tuple[Problem, ...]
    methods: tuple[str, ...]
    max_evals: int
    rankings: Mapping[str, Ranking]  # by kind
    verdicts: tuple[Verdict, ...]  # by error
    speeds: tuple[Verdict, ...]  # by effort, of the kinds that most runs solve
    contrasts: tuple[Contrast, ...]

    def of(self, kind: str) -> list[Problem]:
        """The problems of a kind."""
        return [p for p in self.problems if p.kind == kind]

    @property
    def kinds(self) -> list[str]:
        return [kind for kind in KINDS if self.of(kind)]

    @property
    def n_seeds(self) -> int:
        return min(len(p.seeds) for p in self.problems)

    @property
    def can_be_significant(self) -> bool:
        """Whether the verdicts' paired tests could reach the level with so few seeds, were all seeds to agree."""
        return 2.0 ** (1 - self.n_seeds) * max(len(self.verdicts), 1) < LEVEL

    def success(self, kind: str, method: str) -> Interval:
        """Share of solved runs over all problems of a kind."""
        i = self.methods.index(method)
        hit = np.concatenate([p.hit[i] for p in self.of(kind)])
        return wilson(int(np.isfinite(hit).sum()), len(hit))

    def microseconds(self, kind: str, method: str) -> float:
        """Median time of one evaluation, the method's own work included."""
        i = self.methods.index(method)
        return float(np.median([1e6 * p.runtime_s[i] / p.evals[i] for p in self.of(kind)]))


def summarise(results: Results[Job]) -> Summary:
    """What all jobs together say."""
    problems = collect(results)
    first = problems[0]
    kinds = [kind for kind in KINDS if any(p.kind == kind for p in problems)]
    by_kind = {kind: [p for p in problems if p.kind == kind] for kind in kinds}
    ranked = {kind: ranking(_blocks(kind, found)) for kind, found in by_kind.items()} if len(first.methods) > 1 else {}
    verdicts = _verdicts(by_kind, {p: p.score for p in problems})
    solved = {kind: found for kind, found in by_kind.items() if np.mean([np.isfinite(p.hit) for p in found]) > MOSTLY}
    speeds = _verdicts(solved, {p: p.effort for p in problems})
    contrasts = _contrasts(by_kind)
    return Summary(tuple(problems), first.methods, first.max_evals, ranked, tuple(verdicts), tuple(speeds), tuple(contrasts))


def collect(results: Results[Job]) -> list[Problem]:
    """Runs of the same problem put together, in the order of KINDS."""
    trials: dict[tuple[str, str], list[tuple[Job, dict[str, Array]]]] = {}
    for job, arrays in results.items():
        parts: dict[tuple[str, str], dict[str, Array]] = {}
        for name, x in arrays.items():
            kind, task, key = name.split("/")
            parts.setdefault((kind, task), {})[key] = x
        for place, columns in parts.items():
            trials.setdefault(place, []).append((job, columns))
    return [_problem(*place, trials[place]) for place in sorted(trials, key=lambda place: list(KINDS).index(place[0]))]


def _problem(kind: str, name: str, trials: Sequence[tuple[Job, dict[str, Array]]]) -> Problem:
    p = trials[0][0].parameters
    columns = {
        key: np.stack([found[key] for _, found in trials], axis=1) for key in ("error", "evals", "hit", "runtime_s", "history")
    }
    solved, even = trials[0][1]["levels"].tolist()
    seeds = tuple(job.parameters["seed"] for job, _ in trials)
    return Problem(kind, name, tuple(p["methods"]), seeds, p["max_evals"], **columns, solved=solved, even=even)


def _blocks(kind: str, problems: Sequence[Problem]) -> Array:
    """What methods are ranked on (blocks, M)."""
    if KINDS[kind].seeds_differ:
        return np.concatenate([p.score.T for p in problems])
    return np.stack([np.median(p.score, axis=1) for p in problems])


def _by_seed(problems: Sequence[Problem], scores: Mapping[Problem, Array]) -> tuple[Array, tuple[int, ...]]:
    """Mean scores (M, S) over the problems, and the seeds that all of them have."""
    seeds = sorted(set.intersection(*(set(p.seeds) for p in problems)))
    return np.mean([scores[p][:, [p.seeds.index(s) for s in seeds]] for p in problems], axis=0), tuple(seeds)


def _verdicts(by_kind: Mapping[str, Sequence[Problem]], scores: Mapping[Problem, Array]) -> list[Verdict]:
    """SUBJECT against every other method on every kind, by scores (M, S) of which lower ones are better."""
    found: list[tuple[str, str, PairedTest, int, int, int]] = []
    for kind, problems in by_kind.items():
        methods = problems[0].methods
        others = [m for m in methods if m != SUBJECT]
        mean, seeds = _by_seed(problems, scores)
        if SUBJECT not in methods or not seeds:
            continue
        me = methods.index(SUBJECT)
        single = [[paired_test(scores[p][me], scores[p][methods.index(m)]) for p in problems] for m in others]
        p_single = holm(np.array([t.p for row in single for t in row])).reshape(len(others), len(problems))
        for other, row, p_row in zip(others, single, p_single, strict=True):
            signs = np.array([t.sign for t in row]) * (p_row < LEVEL)
            test = paired_test(mean[me], mean[methods.index(other)])
            found.append((kind, other, test, int(np.sum(signs > 0)), int(np.sum(signs < 0)), len(problems)))
    adjusted = holm(np.array([test.p for _, _, test, *_ in found]))
    return [
        Verdict(kind, SUBJECT, other, test, float(p), better, worse, n)
        for (kind, other, test, better, worse, n), p in zip(found, adjusted, strict=True)
    ]


def _contrasts(by_kind: Mapping[str, Sequence[Problem]]) -> list[Contrast]:
    found: list[tuple[str, str, str, PairedTest]] = []
    for first, second in CONTRASTS:
        if first in by_kind and second in by_kind:
            (one, seeds), (two, others) = (_by_seed(by_kind[k], {p: p.score for p in by_kind[k]}) for k in (first, second))
            if seeds and seeds == others:
                methods = by_kind[first][0].methods
                found += [(first, second, m, paired_test(one[i], two[i])) for i, m in enumerate(methods)]
    adjusted = holm(np.array([test.p for *_, test in found]))
    return [Contrast(*case, float(p)) for case, p in zip(found, adjusted, strict=True)]
