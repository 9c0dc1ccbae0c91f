"""What pages about a publication have in common: cards and tables of verdicts on its claims, bars beside its numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scenarios.report.frame import Card, Section
from scenarios.report.series import ALERT_COLOUR, TRUTH_COLOUR, Trace, numbers
from scenarios.report.tables import text
from scenarios.studies.statistics import Statistic
from scenarios.studies.verdicts import Claim, Verdict, count_verdicts

BADGES = {Verdict.REPRODUCED: "good", Verdict.PARTLY: "bad", Verdict.NOT_REPRODUCED: "stop", Verdict.NOT_TESTED: "idle"}
DIGITS = 4


def verdict_cards(judged: Sequence[Claim]) -> list[Card]:
    """How many claims are reproduced, how many checks met."""
    cards = []
    for name, is_check in (("Claims reproduced", False), ("Further checks met", True)):
        mine = [claim for claim in judged if claim.is_check == is_check]
        good = sum(claim.verdict is Verdict.REPRODUCED for claim in mine)
        cards.append(Card(name, f"{good} of {len(mine)}", count_verdicts(judged, is_check).partition(", ")[2]))
    return cards


def claim_sections(judged: Sequence[Claim], lead: str) -> list[Section]:
    """Claims with `lead` before them, and checks."""
    paper, checks = ([c for c in judged if c.is_check == is_check] for is_check in (False, True))
    return [
        Section("claims", "Claims of the publication", "Claims", html=claim_table(paper, "published"), lead=lead),
        Section("checks", "Further checks", "Checks", html=claim_table(checks, "")),
    ]


def claim_table(found: Sequence[Claim], paper: str) -> str:
    """Claims with what the publication says, headed `paper`, or checks where that is empty; as HTML."""
    head = ["claim" if paper else "check", *([paper] if paper else []), "here", "verdict", "evidence"]
    rows = []
    for claim in found:
        badge = f'<span class="badge {BADGES[claim.verdict]}">{text(claim.word)}</span>'
        cells = [text(claim.text), *([text(claim.paper)] if paper else []), text(claim.ours), badge, text(claim.evidence)]
        rows.append(cells)
    return wrapped(head, rows)


def prose(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of sentences, plain text, whose cells wrap."""
    return wrapped(head, [[text(cell) for cell in row] for row in rows])


def wrapped(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose cells, HTML already, wrap."""
    header = "".join(f"<th>{text(name)}</th>" for name in head)
    body = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="table wrap" tabindex="0"><table><thead><tr>{header}</tr></thead><tbody>{body}</tbody></table></div>'


def bars(x: object, values: Sequence[Statistic], colour: str | Sequence[str], name: str, scale: float = 1.0) -> Trace:
    """Bars with the interval of each value."""
    y = scale * np.array([v.value for v in values])
    above = scale * np.array([v.upper for v in values]) - y
    below = y - scale * np.array([v.lower for v in values])
    whiskers = {
        "type": "data",
        "symmetric": False,
        "array": numbers(above, DIGITS),
        "arrayminus": numbers(below, DIGITS),
        "thickness": 1.3,
        "color": TRUTH_COLOUR,
    }
    return {
        "type": "bar",
        "name": name,
        "x": x,
        "y": numbers(y, DIGITS),
        "marker": {"color": colour if isinstance(colour, str) else list(colour)},
        "error_y": whiskers,
        "hovertemplate": "%{x}: %{y:.4~g}<extra></extra>",
    }


def published(x: object, y: object) -> Trace:
    """Marks of the publication's numbers."""
    marker = {"symbol": "diamond-open", "size": 9, "color": ALERT_COLOUR, "line": {"width": 2}}
    trace: Trace = {"type": "scatter", "mode": "markers", "name": "published", "x": x, "y": y, "marker": marker}
    return trace | {"hovertemplate": "published %{y}<extra></extra>"}
