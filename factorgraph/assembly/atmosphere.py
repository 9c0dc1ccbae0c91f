"""What the atmosphere leaves in differences and single receivers: slowly changing delays beside the states.

A link long enough has, per satellite, a differential vertical ionosphere at L1 (rover minus reference), seen with the
obliquity F(el) = 1 + 16 (0.53 - el)^3 (el in semicircles) and (lambda / lambda_L1)^2, plus sign for code and minus for
phase, and one differential wet delay of the zenith, seen with Niell's wet mapping of the rover's elevation. Both are
Gauss-Markov processes (`assembly.nodes`) whose standard deviation grows with the baseline: the ionosphere-weighted model.

Source: IS-GPS-200, 20.3.3.5.2.5 (obliquity); Schaffrin and Bock (1988), Odijk (2002) for weighting the differential ionosphere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.assembly.blocks import CODE, PHASE, Block, GnssBlock
from factorgraph.assembly.nodes import Nodes, Process
from factorgraph.assembly.rows import plain_rows
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.geodesy import geodetic_from_ecef
from factorgraph.models.atmosphere import niell_wet
from factorgraph.models.combinations import ionosphere_free
from factorgraph.models.gnss import (
    WAVELENGTH_L1_M,
    one_code_per_satellite,
    system_of,
    two_codes_per_satellite,
    without_ionosphere,
)
from factorgraph.models.receivers import Receiver
from factorgraph.problem import NavigationProblem, Settings
from factorgraph.types import Array, IntArray

WET_KEYS = 500_000  # above those of the same block's ionosphere


@dataclass(slots=True)
class NodeBlock(Block):
    """Prior and process of a block's nodes: one row per node, against the node before it."""

    of: Nodes
    decay: Array  # (k,) share of the node before that stays
    only: IntArray | None = None  # (n,) nodes that have rows, of a piece; all without it

    def keys(self, f: int) -> list[int]:
        f = f if self.only is None else int(self.only[f])
        before = self.of.previous[f]
        own = int(self.of.key[f])
        return [own, 0 if before < 0 else int(self.of.key[before])]

    def widths(self) -> tuple[int, ...]:
        return (1, 1)

    def predict(self) -> None:
        x, before = self.of.value, self.of.previous
        y = -np.where(before >= 0, x - self.decay * x[before], x)
        mine = slice(None) if self.only is None else self.only
        self.y, self.J = y[mine], np.column_stack([np.ones(len(x)), -self.decay])[mine]


def node_block(nodes: Nodes, process: Process, source: str) -> NodeBlock:
    """The process that holds nodes together."""
    before = nodes.previous
    n = len(before)
    decay, sigma = process.step(np.where(before >= 0, nodes.t_s - nodes.t_s[before], 1.0))
    rows = plain_rows(
        -1,
        nodes.t_s,
        np.where(before >= 0, sigma, process.sigma),
        np.arange(n),
        f"{source} {nodes.name}",
        [nodes.name],
        np.zeros(n, np.int64),
    )
    return NodeBlock(rows, of=nodes, decay=decay)


def link_atmosphere(
    problem: NavigationProblem, block: GnssBlock, key_base: int, reference: VehicleVariables, rover: VehicleVariables
) -> list[NodeBlock]:
    """What a link sees of ionosphere and wet delay, by how far and how high its ends are from each other."""
    frame, settings = problem.frame, problem.settings
    apart_m = float(np.linalg.norm(rover.r - reference.r, axis=1).max())
    lat, _, h = geodetic_from_ecef(frame.to_ecef(np.array([reference.r, rover.r]).reshape(-1, 3)))
    above_m = float(np.abs(np.diff(h.reshape(2, -1), axis=0)).max())
    found = (
        add_ionosphere(settings, block, key_base, apart_m),
        add_wet_delay(settings, block, key_base, wet_sigma_m(settings, apart_m, above_m), float(lat.mean())),
    )
    return [prior for prior in found if prior is not None]


def receiver_atmosphere(
    problem: NavigationProblem, block: GnssBlock, key_base: int, vehicle: VehicleVariables
) -> list[NodeBlock]:
    """A single receiver's wet delay over the model's, where it is to be estimated."""
    lat, _, _ = geodetic_from_ecef(problem.frame.to_ecef(vehicle.r[:1]))
    found = add_wet_delay(problem.settings, block, key_base, problem.settings.troposphere_absolute_m, float(lat[0]))
    return [] if found is None else [found]


def absolute_codes(settings: Settings, rx: Receiver) -> tuple[IntArray, Array, Array]:
    """Rows of a receiver whose codes are used undifferenced, these codes, and how much noisier than one they are.

    Ionosphere-free: constellations without two bands keep single codes and the ionosphere's model.
    """
    stream = rx.antenna.stream
    single = one_code_per_satellite(stream, rx.usable)
    if settings.absolute_code == "single":
        return single, rx.prepared.code_m[single], np.ones(len(single))
    first, second = two_codes_per_satellite(stream, rx.usable)
    letters = system_of(stream)
    single = single[~np.isin(letters[single], np.unique(letters[first]))]
    whole = without_ionosphere(rx.prepared).code_m
    a, b = ionosphere_free(stream.wavelength_m[first], stream.wavelength_m[second])
    rows = np.concatenate([first, single])
    code = np.concatenate([a * whole[first] + b * whole[second], rx.prepared.code_m[single]])
    noisier = np.concatenate([np.hypot(a, b), np.ones(len(single))])
    order = np.argsort(rows)
    return rows[order], code[order], noisier[order]


def add_ionosphere(settings: Settings, block: GnssBlock, key_base: int, baseline_m: float) -> NodeBlock | None:
    """Give a long link's code and phase rows a differential ionosphere per satellite; None where the link is short."""
    if settings.ionosphere_ppm == 0 or baseline_m < settings.ionosphere_min_baseline_m:
        return None
    rows = block.rows
    sign = np.select([rows.kind == CODE, rows.kind == PHASE], [1.0, -1.0], 0.0)
    scale = sign * obliquity(rows.elevation_rad) * (block.wavelength_m / WAVELENGTH_L1_M) ** 2
    mine = np.flatnonzero(sign != 0)
    nodes = Nodes.of(
        "ionosphere", key_base, mine, rows.label_index[mine], rows.t_s[mine], scale[mine], settings.ionosphere_step_s
    )
    block.nodes.append(nodes)
    process = Process(settings.ionosphere_ppm * 1e-6 * baseline_m, settings.ionosphere_correlation_s)
    return node_block(nodes, process, rows.source)


def obliquity(elevation_rad: Array) -> Array:
    """Slant over vertical ionosphere (n,)."""
    return np.asarray(1 + 16 * (0.53 - elevation_rad / np.pi) ** 3)


def wet_sigma_m(settings: Settings, baseline_m: float, height_m: float) -> float:
    """Standard deviation of a link's differential wet delay; 0 where the link is short and level."""
    if baseline_m < settings.troposphere_min_baseline_m and height_m < settings.troposphere_min_height_m:
        return 0.0
    return float(1e-6 * np.hypot(settings.troposphere_ppm * baseline_m, settings.troposphere_height_ppm * height_m))


def add_wet_delay(settings: Settings, block: GnssBlock, key_base: int, sigma_m: float, lat_rad: float) -> NodeBlock | None:
    """Give a block's code and phase rows a wet delay of the zenith; None where its standard deviation is 0."""
    if sigma_m == 0:
        return None
    rows = block.rows
    mine = np.flatnonzero((rows.kind == CODE) | (rows.kind == PHASE))
    scale = niell_wet(lat_rad, rows.elevation_rad[mine])
    nodes = Nodes.of(
        "wet delay", key_base + WET_KEYS, mine, np.zeros(len(mine), np.int64), rows.t_s[mine], scale, settings.troposphere_step_s
    )
    block.nodes.append(nodes)
    return node_block(nodes, Process(sigma_m, settings.troposphere_correlation_s), rows.source)
