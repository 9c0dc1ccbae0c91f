"""Integer ambiguities as a mixed-integer program: bonmin beside the search of `ambiguity`.

    minimise |L^-1 (a - a_float)|^2 over integers a,   Q = L L',   low <= a <= high

The box about the float solution holds the minimiser: with c = |L^-1 (a_0 - a_float)|^2 of the bootstrapped integers a_0, all
that is as near lies within sqrt(c Q_ii) of the float solution along axis i.

A branch-and-bound knows nothing of lattices: it branches on ambiguities as they are. They come decorrelated (`decorrelate`),
or the box of strongly correlated ones would be thousands of integers wide.

Source: Bonami et al. (2008), An algorithmic framework for convex mixed integer nonlinear programs, for bonmin; Teunissen (1995).
"""

from __future__ import annotations

import contextlib
import io
import time
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ambiguity.bootstrapping import bootstrap
from ambiguity.decorrelation import decorrelate
from factorgraph.errors import InputError
from factorgraph.types import Array, IntArray

MOST = 10  # ambiguities at a time
MARGIN = 1e-9  # relative, on the size of the ellipsoid
QUIET = {"bonmin": {"bb_log_level": 0, "nlp_log_level": 0, "sb": "yes"}}


@dataclass(frozen=True, slots=True)
class Found:
    """The nearest integers as a solver found them."""

    integers: IntArray  # (n,)
    norm: float  # squared distance in the metric of inv(Q)
    status: str  # in the solver's words
    seconds: float


def nearest_integers(a_float: Array, Q: Array) -> Found:
    """The integer vector nearest to a_float (n,) [cyc] in the metric of inv(Q), Q (n, n) [cyc^2], by bonmin.

    Raises InputError for more than MOST ambiguities, for shapes that disagree, where bonmin is not available and where it ends
    without a solution; ValueError as `ambiguity.decorrelate` does.
    """
    a, Q = np.asarray(a_float, float), np.asarray(Q, float)
    n = a.size
    if a.shape != (n,) or Q.shape != (n, n):
        raise InputError(f"{n} ambiguities need a covariance of shape {(n, n)}, got {Q.shape} for floats of shape {a.shape}")
    if not 0 < n <= MOST:
        raise InputError(f"bonmin takes 1 to {MOST} ambiguities, got {n}; `ambiguity.integer_least_squares` takes any number")
    if not ca.has_nlpsol("bonmin"):
        raise InputError("this build of CasADi has no bonmin")
    found = decorrelate(Q)
    whole = np.rint(a)
    z_float, Qz = found.Z @ (a - whole), found.covariance
    white = np.linalg.inv(np.linalg.cholesky(Qz))
    half = _half_widths(z_float, Qz, white)
    z = ca.SX.sym("z", n)
    r = ca.DM(white) @ (z - z_float)
    options: dict[str, Any] = {**QUIET, "discrete": [True] * n, "print_time": False, "error_on_fail": False}
    solver = ca.nlpsol("integers", "bonmin", {"x": z, "f": ca.dot(r, r)}, options)
    start = time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()):  # it logs every node, whatever its options say
        result = solver(x0=np.rint(z_float), lbx=np.ceil(z_float - half), ubx=np.floor(z_float + half))
    seconds = time.perf_counter() - start
    status = str(solver.stats()["return_status"])
    if not solver.stats()["success"]:
        raise InputError(f"bonmin ended without integers: {status}")
    best = np.rint(result["x"].full()[:, 0]).astype(np.int64)
    norm = float(np.sum((white @ (best - z_float)) ** 2))
    return Found(found.Z_inv @ best + whole.astype(np.int64), norm, status, seconds)


def _half_widths(z_float: Array, Qz: Array, white: Array) -> Array:
    """Half the widths (n,) of a box that holds every integer vector as near as the bootstrapped one."""
    c = float(np.sum((white @ (bootstrap(z_float, Qz).integers - z_float)) ** 2))
    return np.asarray(np.sqrt(c * (1 + MARGIN) * np.diag(Qz)) + MARGIN)
