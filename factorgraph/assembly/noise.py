"""Noise of measurement kinds estimated from a solution's own residuals, and put in place of what was declared.

Between the float solution and the integers, and again with the integers, every kind of every source (a link's code, phase and
Doppler, a receiver's Doppler, a pair's ranges) gets its standard deviations from its residuals and redundancy numbers, the
graph is solved again, and so on until they stay. Undifferenced code keeps what was declared: that stands for errors which
persist and do not scatter. A kind of little redundancy is left as it is. Before the integers phases get no better than
declared: float ambiguities take what persists (multipath, antennas) out of their residuals.

    scale       the declared standard deviation times a factor
    elevation   sigma^2 = a^2 + b^2 / sin^2(el) of each receiver of a link
    cn0         sigma^2 = a^2 + b^2 10^(-(CN0 - 45 dB-Hz) / 10) of each receiver of a link

The last two are for links; other kinds are scaled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.assembly.blocks import CODE, DOPPLER, KINDS, PHASE, RANGE, Block, GnssBlock
from factorgraph.assembly.build import GnssLink
from factorgraph.assembly.engine import Covariances
from factorgraph.assembly.optimizer import Graph
from factorgraph.models.noise import Components, components, scale
from factorgraph.models.receivers import Receiver
from factorgraph.problem import NoiseModel
from factorgraph.solution import ParameterEstimate
from factorgraph.types import Array, BoolArray

LEAST = 30.0  # redundancy of a kind below which it keeps what was declared
SMALLEST, LARGEST = 0.1, 10.0  # of a standard deviation, times the declared one
SETTLED = 0.02  # relative change
REFERENCE_DBHZ = 45.0
UNIT = {CODE: "m", PHASE: "m", DOPPLER: "m/s", RANGE: "m"}


@dataclass(slots=True)
class Declared:
    """Standard deviations (n,) of a block before any was estimated."""

    block: Block
    sigma: Array


def declared(graph: Graph) -> list[Declared]:
    """Blocks whose noise is to be estimated, as they are now."""
    return [Declared(b, b.rows.sigma.copy()) for b in graph.blocks if np.any(np.isin(b.rows.kind, list(UNIT)))]


def redundancies(block: Block, cov: Covariances) -> Array:
    """Redundancy number (n,) of every row: the share of its noise that its residual shows. 1 - clock - J P J'."""
    block.whiten()
    taken = block.explained(cov)
    free = block.w > 0
    taken[free] /= block.w[free]
    clock = 0.0 if block.rows.clocks is None else block.rows.clocks.leverage(block.u)
    return np.where(free & block.active, np.clip(1 - clock - taken, 0.0, 1.0), 0.0)


def estimate(
    model: NoiseModel,
    known: list[Declared],
    links: list[GnssLink],
    receivers: dict[str, Receiver],
    cov: Covariances,
    is_float: bool,
) -> tuple[list[ParameterEstimate], float]:
    """Put estimated standard deviations into the blocks' rows; returns what was found and the largest relative change.

    `is_float`: ambiguities are not integers yet.
    """
    found: list[ParameterEstimate] = []
    change = 0.0
    for each in known:
        block = each.block
        link = next((data for data in links if data.block is block), None)
        undifferenced = isinstance(block, GnssBlock) and block.reference is None
        r, v = redundancies(block, cov), block.residuals()
        sigma = block.rows.sigma.copy()
        for kind in UNIT:
            mine = block.rows.kind == kind
            if (undifferenced and kind == CODE) or r[mine].sum() < LEAST:
                continue
            if model == "scale" or link is None:
                got = scale(v[mine], each.sigma[mine], r[mine])
                new = got.value[0] * each.sigma[mine]
            else:
                A = _levels(model, link, receivers, mine)
                got = components(v[mine], sigma[mine], r[mine], A)
                new = np.sqrt(A @ got.value)
            smallest = 1.0 if is_float and kind == PHASE else SMALLEST
            new = np.clip(new, smallest * each.sigma[mine], LARGEST * each.sigma[mine])
            change = max(change, float(np.abs(new / sigma[mine] - 1).max()))
            sigma[mine] = new
            typical = float(np.median(each.sigma[mine]) / np.sqrt(2))
            name = f"{block.rows.source} {KINDS[kind]}"
            found += _reported(name, UNIT[kind], model if link is not None else "scale", got, typical)
        block.rows.sigma = sigma
    return found, change


def _levels(model: NoiseModel, link: GnssLink, receivers: dict[str, Receiver], mine: BoolArray) -> Array:
    """Coefficients (n, 2) of a^2 and b^2 in the variance of a difference: the sum over both receivers."""
    total = np.zeros((int(mine.sum()), 2))
    for name, rows in ((link.link.reference, link.row_reference), (link.link.rover, link.row_rover)):
        rx, own = receivers[name], rows[mine]
        if model == "elevation":
            level = 1 / np.sin(np.maximum(rx.prepared.elevation_rad[own], np.deg2rad(3.0))) ** 2
        else:
            cn0 = rx.antenna.stream.cn0_dbhz[own]
            known = np.isfinite(cn0)
            typical = float(np.median(cn0[known])) if np.any(known) else REFERENCE_DBHZ
            level = 10 ** (-(np.where(known, cn0, typical) - REFERENCE_DBHZ) / 10)
        total += np.column_stack([np.ones(len(own)), level])
    return total


def _reported(name: str, unit: str, model: NoiseModel, got: Components, typical: float) -> list[ParameterEstimate]:
    """`typical`: a standard deviation as declared, which stands for what was known before."""
    if model == "scale":
        return [ParameterEstimate(f"{name} noise factor", "1", float(got.value[0]), float(got.sigma[0]), 1.0, 1.0)]
    out = []
    for part, value, sigma in zip("ab", got.value.tolist(), got.sigma.tolist(), strict=True):
        root = float(np.sqrt(value))
        spread = sigma / (2 * root) if value > sigma else float(np.sqrt(sigma))
        out.append(ParameterEstimate(f"{name} noise {part} ({model})", unit, root, spread, 0.0, typical))
    return out
