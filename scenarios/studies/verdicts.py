"""Claims of a publication with verdicts that follow from numbers over seeds, and the words they are told in.

N is the number of the publication:

    a number           reproduced where N lies within the span of the seeds or near their mean, partly where not far from it
    "at most N"        reproduced where the whole interval of the mean is at most N, partly up to twice N
    "A better than B"  reproduced where the 95 % interval of the paired difference lies on the right side of zero, partly
                       where only the mean does
    "A at least B"     reproduced where that interval is nowhere below zero, partly where it reaches zero
    several at once    reproduced where all are, not reproduced where none is, else partly; what was not run is left out

Further checks, which are not claims of the publication, follow the same rules and are called met.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from scenarios.studies.document import Table
from scenarios.studies.statistics import Statistic


class Verdict(Enum):
    REPRODUCED = "reproduced"
    PARTLY = "partly"
    NOT_REPRODUCED = "not reproduced"
    NOT_TESTED = "not tested"


CHECK_WORDS = {
    Verdict.REPRODUCED: "met",
    Verdict.PARTLY: "partly met",
    Verdict.NOT_REPRODUCED: "not met",
    Verdict.NOT_TESTED: "not tested",
}


@dataclass(frozen=True, slots=True)
class Claim:
    """One statement, what the publication and we find, and the verdict."""

    id: str
    text: str
    paper: str  # value and source
    ours: str  # value with its interval
    verdict: Verdict
    evidence: str
    is_check: bool = False  # a further check, not a claim of the publication

    @property
    def word(self) -> str:
        return CHECK_WORDS[self.verdict] if self.is_check else self.verdict.value


# judging


def near(found: Statistic, value: float, close: float, far: float) -> Verdict:
    """A published number against ours; `close` and `far` are distances from our mean."""
    off = abs(found.value - value)
    if found.low <= value <= found.high or off <= close:
        return Verdict.REPRODUCED
    return Verdict.PARTLY if off <= far else Verdict.NOT_REPRODUCED


def at_most(found: Statistic, bound: float) -> Verdict:
    """Whether a mean is at most a bound; a single seed is its own interval."""
    top = found.upper if np.isfinite(found.upper) else found.value
    if top <= bound:
        return Verdict.REPRODUCED
    return Verdict.PARTLY if found.value <= 2 * bound else Verdict.NOT_REPRODUCED


def positive(found: Statistic) -> Verdict:
    """Whether a difference is above zero."""
    if found.lower > 0:
        return Verdict.REPRODUCED
    return Verdict.PARTLY if found.value > 0 else Verdict.NOT_REPRODUCED


def at_least_zero(found: Statistic) -> Verdict:
    """Whether a difference is nowhere below zero; a single seed is its own interval."""
    bottom, top = (bound if np.isfinite(bound) else found.value for bound in (found.lower, found.upper))
    if bottom >= 0:
        return Verdict.REPRODUCED
    return Verdict.PARTLY if top >= 0 else Verdict.NOT_REPRODUCED


def shifted(found: Statistic, by: float) -> Statistic:
    """A statistic of x + by from that of x."""
    value, lower, upper, low, high = (v + by for v in found.numbers)
    return Statistic(value, lower, upper, low, high, found.n)


def negated(found: Statistic) -> Statistic:
    """A statistic of -x from that of x."""
    return Statistic(-found.value, -found.upper, -found.lower, -found.high, -found.low, found.n)


def holds(condition: bool) -> Verdict:
    return Verdict.REPRODUCED if condition else Verdict.NOT_REPRODUCED


def together(parts: Iterable[Verdict]) -> Verdict:
    """The verdict of several parts that are claimed at once."""
    tested = {part for part in parts if part is not Verdict.NOT_TESTED}
    if not tested:
        return Verdict.NOT_TESTED
    return tested.pop() if len(tested) == 1 else Verdict.PARTLY


# words


def shown(found: Statistic | None, unit: str = "", form: str = ".3g", scale: float = 1.0) -> str:
    """A mean with its interval, in words."""
    if found is None or not np.isfinite(found.value):
        return "–"
    value = f"{plain(scale * found.value, form)}{' ' if unit else ''}{unit}"
    if not np.isfinite(found.lower):
        return value
    return f"{value} ({plain(scale * found.lower, form)} to {plain(scale * found.upper, form)})"


def plain(value: float, form: str = ".3g") -> str:
    """A number by a format, without an exponent where it is large, with a true minus sign."""
    if not np.isfinite(value):
        return "–"
    text = format(value, form)
    text = f"{float(text):.0f}" if "e+" in text else text
    return "−" + text[1:] if text.startswith("-") and float(text) != 0 else text.removeprefix("-")


def untested(id: str, text: str, paper: str, missing: str, is_check: bool = False) -> Claim:
    return Claim(id, text, paper, "–", Verdict.NOT_TESTED, f"Not run: {missing}.", is_check)


def seed_count(n: int) -> str:
    return f"{n} seed" if n == 1 else f"{n} seeds"


def count_verdicts(found: Sequence[Claim], is_check: bool) -> str:
    """How many claims have which verdict, in words."""
    mine = [claim for claim in found if claim.is_check == is_check]
    counts = {verdict: [claim for claim in mine if claim.verdict is verdict] for verdict in Verdict}
    return ", ".join(f"{len(group)} {group[0].word}" for group in counts.values() if group) or "none"


def verdict_table(found: Sequence[Claim], source: str) -> Table:
    """Claims with what the publication says, headed `source`, or checks where that is empty."""
    head = ("claim", source, "here", "verdict", "evidence") if source else ("check", "here", "verdict", "evidence")
    rows = tuple((c.text, *([c.paper] if source else []), c.ours, c.word, c.evidence) for c in found)
    return Table("", head, rows, n_text=len(head))


def listed_claims(found: Sequence[Claim]) -> list[list[str]]:
    """Claims as lists of texts, for files: id, text, publication, here, verdict, evidence."""
    return [[c.id, c.text, c.paper, c.ours, c.word, c.evidence] for c in found]
