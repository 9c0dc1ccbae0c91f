"""Integers held by switches instead of for good: phases that refuse an integer let it go by themselves.

A fixed ambiguity stays a variable a with a soft constraint to its integer N,

    e = s (a - N) / SIGMA_CYC,    s = min(1, 2 c^2 / (c^2 + t^2)),  t = (a - N) / SIGMA_CYC

where s is the value that a switch variable of the constraint would take (dynamic covariance scaling, `models.robust`). It
begins to open when the phases pull the ambiguity c SIGMA_CYC = 0.1 cycles away from its integer: more than noise and antennas
do, and much less than a wrong integer, which is off by one.

Source: Suenderhauf and Protzel (2012), Switchable constraints for robust pose graph SLAM; Agarwal et al. (2013) for the
closed form of the switch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from factorgraph.assembly.blocks import Block, GnssBlock
from factorgraph.assembly.rows import plain_rows
from factorgraph.models.robust import Loss, cost, weight
from factorgraph.problem import Robust
from factorgraph.types import Array, IntArray

SIGMA_CYC = 0.01
SWITCH = Robust("dcs", 10.0)
OPEN = 0.5  # weight below which an integer counts as refused


@dataclass(slots=True)
class HeldBlock(Block):
    """Constraints of a link's ambiguities to integers."""

    of: GnssBlock
    integer: Array  # (n,)
    valid_for: IntArray  # the keys of the link's ambiguities; others once its arcs are made anew

    @property
    def is_stale(self) -> bool:
        return self.valid_for is not self.of.amb_key

    @property
    def version(self) -> tuple[int, ...]:
        return (self.of.structure, int(self.active.sum()))


@dataclass(slots=True)
class SwitchBlock(HeldBlock):
    """Constraints of single ambiguities, one row each, that their phases may switch off."""

    arc: IntArray  # (n,)

    def keys(self, f: int) -> list[int]:
        return [int(self.of.amb_key[self.arc[f]])]

    def widths(self) -> tuple[int, ...]:
        return (1,)

    def predict(self) -> None:
        self.y = self.integer - self.of.amb_value[self.arc]
        self.J = np.ones((self.n, 1))

    def reweight(self, losses: Mapping[str, Loss], afresh: bool = False) -> None:
        """The switches settle with the ambiguities, whatever the losses of measurements are."""
        self.w = np.where(self.active, weight(SWITCH, self.y / self.rows.sigma), 0.0)

    def cost(self, losses: Mapping[str, Loss]) -> float:
        return float(np.sum(cost(SWITCH, (self.y / self.rows.sigma)[self.active])))

    def open_arcs(self) -> IntArray:
        """Arcs whose switch has opened; their constraints end."""
        refused = self.active & (self.w < OPEN)
        self.active &= ~refused
        return self.arc[refused]


def hold(block: GnssBlock, arc: IntArray, source: str) -> SwitchBlock:
    """Constraints of arcs to the integers that are their ambiguities' values now."""
    n = len(arc)
    rows = plain_rows(-1, np.zeros(n), np.full(n, SIGMA_CYC), np.arange(n), source, ["integer"], np.zeros(n, np.int64))
    return SwitchBlock(rows, of=block, arc=arc, integer=np.round(block.amb_value[arc]), valid_for=block.amb_key)
