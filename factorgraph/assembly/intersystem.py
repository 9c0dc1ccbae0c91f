"""One receiver clock for several constellations, with constant biases between them.

Signals of one frequency share their clock; each group of signals but the most observed has a constant bias against it, for
code and for phase, rover minus reference. All Doppler shares one clock rate. What a phase's bias is in whole cycles cannot
be told from its ambiguities: each group keeps a datum of its own, an arbitrary integer, and the bias takes up the rest.

Source: Odijk and Teunissen (2013), Characterization of between-receiver GPS-Galileo inter-system biases and their effect on
mixed ambiguity resolution.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factorgraph.assembly.blocks import CODE, DOPPLER, KINDS, PHASE, GnssBlock
from factorgraph.assembly.parameters import Parameter, Parameters
from factorgraph.types import Array, IntArray

PRIOR_M = 1000.0  # of a bias: a few microseconds
SAME_M = 1e-6  # wavelengths that differ by less are of one frequency


def shared_clocks(kind: IntArray, group: IntArray, names: Sequence[str], wavelength_m: Array) -> IntArray:
    """Number (n,) of the clock of each row within its epoch and kind, when constellations share clocks.

    names: of the groups, their constellation's letter first; GLONASS, whose satellites have frequencies of their own, shares
    none but its rate.
    """
    first = np.full(len(names), -1, np.int64)
    present, row = np.unique(group, return_index=True)
    first[present] = row
    clock = np.arange(len(names))
    for g in present:
        same = [h for h in present if h <= g and abs(wavelength_m[first[h]] - wavelength_m[first[g]]) < SAME_M]
        if names[g][0] != "R":
            clock[g] = min(h for h in same if names[h][0] != "R")
    return np.where(kind == DOPPLER, 0, clock[group])


def biases(
    kind: IntArray, group: IntArray, clock: IntArray, names: Sequence[str], source: str, parameters: Parameters
) -> tuple[list[Parameter], IntArray]:
    """Parameters of the biases, and which of them (n,) each row sees, -1 none."""
    found: list[Parameter] = []
    of_row = np.full(len(kind), -1, np.int64)
    for k in (CODE, PHASE):
        for c in np.unique(clock[kind == k]):
            mine = (kind == k) & (clock == c)
            groups, count = np.unique(group[mine], return_counts=True)
            against = groups[np.argmax(count)]
            for g in groups[groups != against]:
                of_row[mine & (group == g)] = len(found)
                name = f"{source} {KINDS[k]} {names[g]} - {names[against]}"
                found.append(parameters.add(name, ("",), "m", np.zeros(1), np.array([PRIOR_M])))
    return found, of_row


def start_biases(block: GnssBlock) -> None:
    """Start values from the residuals at the current trajectory: medians over the epochs that have both groups."""
    if not block.biases:
        return
    for bias in block.biases:
        bias.value = np.zeros(1)
    block.predict()
    rows = block.rows
    label = rows.factor.of_row * len(rows.group) + rows.group_index
    for i, bias in enumerate(block.biases):
        mine = np.flatnonzero((block.bias_of == i) & block.active)
        if not len(mine):
            continue
        clocks = block.clock_index[mine[0]]
        others = (block.clock_index == clocks) & (rows.kind == rows.kind[mine[0]]) & (block.bias_of < 0) & block.active
        own, reference = _means(block, label, mine), _means(block, label, np.flatnonzero(others))
        against = rows.group_index[others][0] if np.any(others) else 0
        g = rows.group_index[mine[0]]
        epochs = np.arange(len(rows.factor.start)) * len(rows.group)
        apart = own[epochs + g] - reference[epochs + against]
        known = np.isfinite(apart)
        bias.value = np.array([np.median(apart[known]) if np.any(known) else 0.0])


def _means(block: GnssBlock, label: IntArray, rows: IntArray) -> Array:
    """Mean residual of every epoch and group, NaN where there is none of `rows`."""
    size = len(block.rows.factor.start) * len(block.rows.group)
    count = np.bincount(label[rows], minlength=size)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.bincount(label[rows], block.y[rows], minlength=size) / np.where(count > 0, count, np.nan))
