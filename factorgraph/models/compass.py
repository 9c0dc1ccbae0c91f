"""The line between two antennas of one vehicle, epoch by epoch, from carrier phase and its known length.

Differences rover - reference of code and phase, and of these the differences to one satellite per clock, with e from antenna
to satellite:

    P = -(e_s - e_ref) . d,    Phi = -(e_s - e_ref) . d + lambda (N_s - N_ref),    |d| = length

The integers are those that fit best together with a line of that length; an epoch counts where no other integers fit nearly
as well.
Source: Teunissen (2010), the constrained (GNSS compass) model.
"""

from __future__ import annotations

import numpy as np

from ambiguity.constrained import float_solution, length_constrained
from factorgraph.alignment import Directions
from factorgraph.geodesy import LocalFrame
from factorgraph.models.gnss import pair_rows
from factorgraph.models.receivers import Receiver, difference_sigma
from factorgraph.sampling import interpolate
from factorgraph.types import Array, IntArray

EPOCHS = 200  # at most, evenly over the flight
FEWEST = 5  # double differences of phase
DISCRIMINATION = 2.0  # of the second best integers' objective to the best's
LENGTH_SIGMA_M = 0.01  # how well lever arms are known
PHASE_M = 0.005  # least standard deviation, with multipath
MAX_NODES = 20_000
MISFIT = 3.0  # largest mean square of the whitened misfit


def antenna_line(
    reference: Receiver, rover: Receiver, frame: LocalFrame, bands: str, t_s: Array, r_n: Array
) -> Directions | None:
    """Directions from the reference's to the rover's antenna of one vehicle; None where no epoch tells.

    t_s (K,), r_n (K, 3): where the vehicle is, good to metres.
    """
    arm = np.asarray(rover.lever_b, float) - np.asarray(reference.lever_b, float)
    length = float(np.linalg.norm(arm))
    if length < 3 * LENGTH_SIGMA_M:
        return None
    a, b = reference.antenna.stream, rover.antenna.stream
    pairs = pair_rows(a, b, reference.usable, rover.usable, bands)
    whole = ((a.lli[pairs.a] | b.lli[pairs.b]) & 2) == 0
    whole &= np.isfinite(a.phase_cyc[pairs.a]) & np.isfinite(b.phase_cyc[pairs.b])
    whole &= np.isfinite(a.code_m[pairs.a]) & np.isfinite(b.code_m[pairs.b])
    whole &= ~np.char.startswith(np.array(b.satellites)[b.sat[pairs.b]], "R")
    rows = np.flatnonzero(whole)
    epochs = np.unique(pairs.epoch[rows])
    epochs = epochs[np.linspace(0, len(epochs) - 1, min(EPOCHS, len(epochs))).astype(int)] if len(epochs) else epochs
    rows = rows[np.isin(pairs.epoch[rows], epochs)]
    line = _Line(reference, rover, pairs.a[rows], pairs.b[rows], t_s, r_n)
    found = []
    for epoch in epochs:
        mine = np.flatnonzero(pairs.epoch[rows] == epoch)
        one = line.at(mine, pairs.group[rows][mine], length)
        if one is not None:
            found.append((b.t_s[epoch], *one))
    if not found:
        return None
    t, d, sigma = (np.array(column) for column in zip(*found, strict=True))
    size = np.linalg.norm(d, axis=1)
    return Directions("antennas", t, np.tile(arm / length, (len(t), 1)), d / size[:, None], sigma / length)


class _Line:
    """Differences of two receivers' rows, the ranges to the vehicle's place taken off."""

    def __init__(self, reference: Receiver, rover: Receiver, ra: IntArray, rb: IntArray, t_s: Array, r_n: Array) -> None:
        pa, pb = reference.differenced, rover.differenced
        at_a, at_b = (interpolate(p.t_s[rows], t_s, r_n) for p, rows in ((pa, ra), (pb, rb)))
        d = pb.sat_n[rb] - at_b
        rho = np.linalg.norm(d, axis=1)
        geometry = rho - np.linalg.norm(pa.sat_n[ra] - at_a, axis=1)
        self.e = d / rho[:, None]
        self.elevation = pb.elevation_rad[rb]
        self.code = pb.code_m[rb] - pa.code_m[ra] - geometry
        self.phase = pb.phase_m[rb] - pa.phase_m[ra] - geometry
        self.wavelength = rover.antenna.stream.wavelength_m[rb]
        self.sigma_code = difference_sigma("code_m", reference, rover, ra, rb)
        self.sigma_phase = np.hypot(difference_sigma("phase_m", reference, rover, ra, rb), PHASE_M)

    def at(self, rows: IntArray, group: IntArray, length: float) -> tuple[Array, float] | None:
        """The line (3,) and its standard deviation per axis at an epoch; None where its integers are in doubt."""
        D = _to_highest(group, self.elevation[rows])
        n = len(D)
        if n < FEWEST:
            return None
        B = -D @ self.e[rows]
        A = np.vstack([np.zeros((n, n)), np.diag(self.wavelength[rows][np.argmax(D, axis=1)])])
        y = np.concatenate([D @ self.code[rows], D @ self.phase[rows]])
        Q = np.zeros((2 * n, 2 * n))
        Q[:n, :n], Q[n:, n:] = D @ np.diag(self.sigma_code[rows] ** 2) @ D.T, D @ np.diag(self.sigma_phase[rows] ** 2) @ D.T
        try:
            best = length_constrained(float_solution(A, np.vstack([B, B]), y, Q), length, LENGTH_SIGMA_M, 2, MAX_NODES)
        except ValueError:  # too few directions to tell a line
            return None
        misfit, second = best.objectives[:2]
        if not best.proven or second < DISCRIMINATION * misfit + 3.0:
            return None
        e = y - A @ best.candidates[0] - np.concatenate([B @ best.b[0]] * 2)
        if e @ np.linalg.solve(Q, e) > MISFIT * (len(y) - 3):
            return None
        return best.b[0], float(np.sqrt(np.trace(best.Q_b) / 3))


def _to_highest(group: IntArray, elevation: Array) -> Array:
    """Matrix (m, n) of differences to the highest row of each clock group."""
    rows = []
    for g in np.unique(group):
        mine = np.flatnonzero(group == g)
        top = mine[np.argmax(elevation[mine])]
        for i in mine[mine != top]:
            row = np.zeros(len(group))
            row[i], row[top] = 1.0, -1.0
            rows.append(row)
    return np.array(rows) if rows else np.zeros((0, len(group)))
