"""What is measured of a formation: rows of double differences, absolute differences, ranges and heights, epoch by epoch.

    DD P        = -(e_s - e_1) r                          + noise       e: line of sight from between both vehicles
    -lam DD D   = -(e_s - e_1) v - (de_s - de_1)/dt r     + noise       1: the highest satellite
    r_abs, v_abs = r, v                                   + noise       differences of the vehicles' own filters
    range       = (scale + k) |r_b + a_b - r_a - a_a| + b + noise       a: arms from a body's origin to its tag

in Earth-fixed axes. Double differences are not linearised: what is measured is set against exact ranges at the prediction, and
the row carries the difference, z = measured - predicted(r) + H r. Followers share the reference's noise, and all differences to
one pivot share the pivot's; both are in R. Differences of the vehicles' own filters were computed from the same code: their
covariance is multiplied (`AbsoluteDifferences.factor`) because they are not independent of the double differences. Errors k of
the scale and biases b of ranges may be constants of the filter; the source estimates neither.

Source: Lu et al. (2024), eqs. 32 to 35; spec ahrs_tdo.md, section 2.4, errata E17 to E19 and E28; spec common.md, section 5.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from factorgraph.filters.relative.motion import EARTH_RATE, position, velocity
from factorgraph.geodesy import LocalFrame
from factorgraph.models import double_differences as dd
from factorgraph.models.double_differences import PairEpochs
from factorgraph.models.gnss import elevation_scale
from factorgraph.problem import GnssNoise
from factorgraph.types import Array, BoolArray, IntArray

KINDS = ("code", "doppler", "position", "velocity", "range", "height")
CODE, DOPPLER, POSITION, VELOCITY, RANGE, HEIGHT = range(len(KINDS))
MATCH_S = 2e-3  # measurements within this of an epoch's first one belong to it
ROUNDING_S = 1e-7
FEWEST = 2  # satellites of a difference


@dataclass(frozen=True, slots=True)
class Rows:
    """Measurements of one epoch; n states, m rows. Rows of distances are h = (scale + k) |D x + d| + H x, the others h = H x."""

    z: Array  # (m,)
    H: Array  # (m, n); of distances their bias
    R: Array  # (m, m)
    kind: IntArray  # (m,) of KINDS
    labels: tuple[str, ...]  # (m,) vehicles, and satellites less pivot or axis
    norm_rows: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (q,)
    norm_D: Array = field(default_factory=lambda: np.zeros((0, 3, 0)))  # (q, 3, n)
    norm_d: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (q, 3)
    norm_scale: Array = field(default_factory=lambda: np.zeros(0))  # (q,)
    norm_state: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (q,) the state k, -1 without

    def scales(self, x: Array) -> Array:
        """Scale (q,) of every distance at x (n,)."""
        return self.norm_scale + np.where(self.norm_state >= 0, x[self.norm_state], 0.0)

    def linearised(self, x: Array) -> tuple[Array, Array]:
        """Innovations (m,) and rows (m, n) at x (n,); a distance of zero has no direction and says nothing."""
        nu, H = self.z - self.H @ x, self.H
        if len(self.norm_rows):
            way = self.norm_D @ x + self.norm_d
            size = np.linalg.norm(way, axis=1)
            unit = way / np.where(size > 0, size, np.inf)[:, None]
            scale, told = self.scales(x), np.flatnonzero(self.norm_state >= 0)
            H = H.copy()
            H[self.norm_rows] += scale[:, None] * np.einsum("qa,qan->qn", unit, self.norm_D)
            H[self.norm_rows[told], self.norm_state[told]] += size[told]
            nu[self.norm_rows] -= scale * size
        return nu, H


@dataclass(frozen=True, slots=True)
class Places:
    """Where the vehicles' points are, apart from the states: K epochs, N vehicles, ECEF axes."""

    reference_e: Array  # (K, 3) of the reference's body
    reference_v_e: Array  # (K, 3)
    arm_e: Array  # (N, K, 3) from each body to its antenna
    arm_v_e: Array  # (N, K, 3) how fast it turns


class Source(Protocol):
    """Measurements of one kind."""

    def rows(self, k: int, x: Array) -> Rows | None:
        """Those of epoch k, set against the predicted states x (n,); None without any."""
        ...


def stacked(parts: Sequence[Rows]) -> Rows:
    """Independent sets of rows as one, in their order."""
    sizes = np.cumsum([0, *(len(part.z) for part in parts)])
    R = np.zeros((sizes[-1], sizes[-1]))
    for part, a, b in zip(parts, sizes, sizes[1:], strict=False):
        R[a:b, a:b] = part.R
    return Rows(
        np.concatenate([part.z for part in parts]),
        np.concatenate([part.H for part in parts]),
        R,
        np.concatenate([part.kind for part in parts]),
        tuple(label for part in parts for label in part.labels),
        np.concatenate([part.norm_rows + a for part, a in zip(parts, sizes, strict=False)]),
        np.concatenate([part.norm_D if len(part.norm_rows) else np.zeros((0, 3, parts[0].H.shape[1])) for part in parts]),
        np.concatenate([part.norm_d for part in parts]),
        np.concatenate([part.norm_scale for part in parts]),
        np.concatenate([part.norm_state for part in parts]),
    )


def epochs_of(t_s: Array) -> Array:
    """Epochs (K,) of measurement times (n,) in any order: an epoch holds what follows its first one within MATCH_S."""
    out: list[float] = []
    for t in np.unique(t_s).tolist():
        if not out or t > out[-1] + MATCH_S + ROUNDING_S:
            out.append(t)
    return np.array(out)


def epoch_of(t_s: Array, epochs_s: Array) -> IntArray:
    """Of each time (n,) the one epoch that it belongs to, -1 for times that none holds."""
    k = np.searchsorted(epochs_s, t_s + ROUNDING_S, side="right") - 1
    inside = (k >= 0) & (t_s <= epochs_s[np.maximum(k, 0)] + MATCH_S + ROUNDING_S)
    return np.where(inside, k, -1)


def measured_at(t_s: Array, epochs_s: Array) -> IntArray:
    """Of each epoch (K,) the index into times (n,) of what belongs to it, -1 without; each time serves one epoch."""
    out = np.full(len(epochs_s), -1)
    k = epoch_of(t_s, epochs_s)
    out[k[k >= 0]] = np.flatnonzero(k >= 0)
    return out


@dataclass(frozen=True, slots=True)
class PairNoise:
    """Undifferenced noise of a link's two receivers."""

    reference: GnssNoise
    rover: GnssNoise


class CodeAndRate:
    """Double-differenced code and range rate of every follower against the reference.

    data: single differences follower less reference of each link, with the index of its follower (from 0).
    """

    def __init__(
        self, data: dict[int, PairEpochs], noise: dict[int, PairNoise], places: Places, frame: LocalFrame,
        epochs_s: Array, names: tuple[str, ...], n: int, kinds: Collection[str] = ("code", "doppler"),
    ) -> None:  # fmt: skip
        self.kinds = [KINDS.index(kind) for kind in ("code", "doppler") if kind in kinds]
        self.links = {i: _Link.of(pair, noise[i], frame, epochs_s) for i, pair in data.items()}
        self.places, self.epochs_s, self.names, self.n = places, epochs_s, names, n
        self.satellites = sorted({name for pair in data.values() for name in pair.satellites})

    def rows(self, k: int, x: Array) -> Rows | None:
        seen = [(i, link, int(link.epoch[k])) for i, link in self.links.items() if link.epoch[k] >= 0]
        found = [(i, link, j, link.pair.order(j)) for i, link, j in seen]
        found = [one for one in found if len(one[3]) >= FEWEST]
        if not found:
            return None
        parts = [self._of_link(i, link, j, k, order, x) for i, link, j, order in found]
        code, rate, H_code, H_rate = (np.concatenate(column) for column in zip(*parts, strict=True))
        R_code = self._noise([(link, link.code_m, j, order) for _, link, j, order in found])
        R_rate = self._noise([(link, link.doppler_mps, j, order) for _, link, j, order in found])
        labels = tuple(label for i, link, _, order in found for label in self._labels(i, link, order))
        both = {CODE: (code, H_code, R_code), DOPPLER: (rate, H_rate, R_rate)}
        return stacked([Rows(*both[kind], np.full(len(labels), kind), labels) for kind in self.kinds])

    def _labels(self, i: int, link: _Link, order: IntArray) -> list[str]:
        satellites = link.pair.satellites
        return [f"{self.names[i + 1]} {satellites[s]}-{satellites[order[0]]}" for s in order[1:]]

    def _of_link(self, i: int, link: _Link, j: int, k: int, order: IntArray, x: Array) -> tuple[Array, Array, Array, Array]:
        """Code and rate (m,) as linear rows (m, n), of follower i at epoch j of its link and k of ours."""
        pair, places = link.pair, self.places
        v, r = velocity(i), position(i)
        va = places.reference_v_e[k] + places.arm_v_e[0, k]
        vb = places.reference_v_e[k] + x[v] + places.arm_v_e[i + 1, k]
        ra = places.reference_e[k] + places.arm_e[0, k] + (pair.t_reference_s[j] - self.epochs_s[k]) * va
        rb = places.reference_e[k] + x[r] + places.arm_e[i + 1, k] + (pair.t_rover_s[j] - self.epochs_s[k]) * vb
        sat, speed = link.sat_e[:, j], link.vel_e[:, j]
        rho, rate, G = dd.predict(sat[0], sat[1], speed[0], speed[1], order, ra, va, rb, vb)
        G_rate = _sight_rates(
            0.5 * (sat[0] + sat[1])[order], 0.5 * (speed[0] + speed[1])[order], 0.5 * (ra + rb), 0.5 * (va + vb)
        )
        H_code, H_rate = np.zeros((2, len(rho), self.n))
        H_code[:, r], H_rate[:, v], H_rate[:, r] = G, G, G_rate
        code = dd.difference(pair.code_m[j], order) - rho + G @ x[r]
        doppler = dd.difference(pair.rate_mps[j], order) - rate + G @ x[v] + G_rate @ x[r]
        return code, doppler, H_code, H_rate

    def _noise(self, found: list[tuple[_Link, Array, int, IntArray]]) -> Array:
        """R of one quantity with undifferenced sigmas (2, J, S), links after each other; they share the reference's noise."""
        S = len(self.satellites)
        variance = np.zeros(S * (1 + len(found)))
        D = np.zeros((sum(len(order) - 1 for *_, order in found), len(variance)))
        row = 0
        for number, (link, sigma, j, order) in enumerate(found):
            column = np.array([self.satellites.index(link.pair.satellites[s]) for s in order])
            for start, sign, end in ((0, -1.0, 0), (S * (1 + number), 1.0, 1)):
                variance[start + column] = sigma[end, j, order] ** 2
                rows = np.arange(row, row + len(order) - 1)
                D[rows, start + column[1:]] = sign
                D[rows, start + column[0]] = -sign
            row += len(order) - 1
        return np.asarray((D * variance) @ D.T)


@dataclass(frozen=True, slots=True)
class _Link:
    """A link with what does not change from run to run: J epochs, S satellites; reference first, rover second."""

    pair: PairEpochs
    epoch: IntArray  # (K,) of ours -> of the link, -1 without
    sat_e: Array  # (2, J, S, 3) ECEF
    vel_e: Array  # (2, J, S, 3)
    code_m: Array  # (2, J, S) undifferenced standard deviations
    doppler_mps: Array

    @classmethod
    def of(cls, pair: PairEpochs, noise: PairNoise, frame: LocalFrame, epochs_s: Array) -> _Link:
        """Satellites turned to ECEF; the rover's elevations serve both receivers."""
        told = (noise.reference, noise.rover)
        scale = np.array([elevation_scale(pair.elevation_rad, one.elevation) for one in told])
        code, doppler = (
            np.array([getattr(one, name) for one in told])[:, None, None] * scale for name in ("code_m", "doppler_mps")
        )
        sat = frame.to_ecef(np.array([pair.sat_reference, pair.sat_rover]))
        speed = frame.rotate_to_ecef(np.array([pair.vel_reference, pair.vel_rover]))
        return cls(pair, measured_at(pair.t_rover_s, epochs_s), sat, speed, code, doppler)


def _sight_rates(sat: Array, speed: Array, middle: Array, v: Array) -> Array:
    """-(de_s - de_1)/dt (m, 3): how fast the lines of sight turn, de/dt = (I - e e')(v_s - v) / rho, the pivot first."""
    way, against = sat - middle, speed - v
    rho = np.sqrt(np.einsum("si,si->s", way, way))[:, None]
    e = way / rho
    turn = (against - e * np.einsum("si,si->s", e, against)[:, None]) / rho
    return np.asarray(turn[0] - turn[1:])


class AbsoluteDifferences:
    """Positions and velocities of the vehicles' own filters, follower less reference.

    r_e, v_e (N, K, 3) ECEF and P (N, K, 6, 6) of position and velocity; NaN where a vehicle has none. `factor` multiplies the
    covariance, see above. `only`: followers used.
    """

    def __init__(
        self, r_e: Array, v_e: Array, P: Array, names: tuple[str, ...], n: int, factor: float = 4.0,
        only: Collection[int] | None = None,
    ) -> None:  # fmt: skip
        self.only = range(len(r_e) - 1) if only is None else only
        self.r_e, self.v_e, self.P, self.names, self.n, self.factor = r_e, v_e, P, names, n, factor
        self.known: BoolArray = np.isfinite(np.concatenate([r_e, v_e, P.reshape(*r_e.shape[:2], 36)], axis=2)).all(axis=2)

    def rows(self, k: int, x: Array) -> Rows | None:
        followers = [i for i in self.only if self.known[i + 1, k]]
        if not self.known[0, k] or not followers:
            return None
        m = len(followers)
        H, z, R = np.zeros((6 * m, self.n)), np.zeros(6 * m), np.zeros((6 * m, 6 * m))
        for a, i in enumerate(followers):
            rows = slice(6 * a, 6 * a + 6)
            H[6 * a : 6 * a + 3, position(i)] = H[6 * a + 3 : 6 * a + 6, velocity(i)] = np.eye(3)
            z[rows] = [*(self.r_e[i + 1, k] - self.r_e[0, k]), *(self.v_e[i + 1, k] - self.v_e[0, k])]
            for b in range(m):
                R[rows, 6 * b : 6 * b + 6] = self.P[0, k]
            R[rows, rows] += self.P[i + 1, k]
        labels = tuple(f"{self.names[i + 1]} {axis}" for i in followers for axis in (*"xyz", *"xyz"))
        return Rows(z, H, self.factor * R, np.tile(np.repeat([POSITION, VELOCITY], 3), m), labels)


@dataclass(frozen=True, slots=True)
class RangeRow:
    """One range: vehicles by number, the reference 0, and arms (3,) from each one's origin to its tag in Earth-fixed axes."""

    a: int
    b: int
    arm_e: Array  # of b less that of a
    range_m: float
    sigma_m: float
    label: str
    scale: int = -1  # which of the filter's constants is the error of its scale, -1: none
    bias: int = -1


class Distances:
    """Ranges between the vehicles, by epoch; `scale` is the crystal's factor where known.

    first_constant: the state of the constants that rows name; None: ranges are believed to have none.
    """

    def __init__(
        self, by_epoch: dict[int, list[RangeRow]], n: int, scale: float = 1.0, first_constant: int | None = None
    ) -> None:
        self.by_epoch, self.n, self.scale, self.first = by_epoch, n, scale, first_constant

    def rows(self, k: int, x: Array) -> Rows | None:
        found = self.by_epoch.get(k, [])
        if not found:
            return None
        m = len(found)
        D, H = np.zeros((m, 3, self.n)), np.zeros((m, self.n))
        state = np.full(m, -1)
        for row, one in enumerate(found):
            for vehicle, sign in ((one.b, 1.0), (one.a, -1.0)):
                if vehicle > 0:
                    D[row, :, position(vehicle - 1)] += sign * np.eye(3)
            if self.first is not None and one.bias >= 0:
                H[row, self.first + one.bias] = 1.0
            if self.first is not None and one.scale >= 0:
                state[row] = self.first + one.scale
        return Rows(
            np.array([one.range_m for one in found]),
            H,
            np.diag([one.sigma_m**2 for one in found]),
            np.full(m, RANGE),
            tuple(one.label for one in found),
            np.arange(m),
            D,
            np.array([one.arm_e for one in found]),
            np.full(m, self.scale),
            state,
        )


@dataclass(frozen=True, slots=True)
class HeightRow:
    """The height of a follower over the reference [m]; up (3,) is the vertical in Earth-fixed axes."""

    follower: int
    up_e: Array
    height_m: float
    sigma_m: float
    label: str


class Heights:
    """Heights of followers over a reference that stands still."""

    def __init__(self, by_epoch: dict[int, list[HeightRow]], n: int) -> None:
        self.by_epoch, self.n = by_epoch, n

    def rows(self, k: int, x: Array) -> Rows | None:
        found = self.by_epoch.get(k, [])
        if not found:
            return None
        H = np.zeros((len(found), self.n))
        for row, one in enumerate(found):
            H[row, position(one.follower)] = one.up_e
        z, sigma = np.array([(one.height_m, one.sigma_m) for one in found]).T
        return Rows(z, H, np.diag(sigma**2), np.full(len(found), HEIGHT), tuple(one.label for one in found))


def arms(C_eb: Array, w_b: Array, lever_b: Array) -> tuple[Array, Array]:
    """Arm (K, 3) and its velocity (K, 3) in Earth-fixed axes of attitudes (K, 3, 3) and inertial rates (K, 3)."""
    arm = C_eb @ lever_b
    return arm, np.einsum("kij,kj->ki", C_eb, np.cross(w_b, lever_b)) - np.cross(EARTH_RATE, arm)
