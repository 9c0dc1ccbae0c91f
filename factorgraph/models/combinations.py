"""Combinations of two frequencies of one satellite, from wavelengths alone.

    ionosphere-free   (l2^2 P1 - l1^2 P2) / (l2^2 - l1^2)               no ionosphere of first order
    wide lane         N1 - N2, of wavelength l1 l2 / (l2 - l1)
    Melbourne-Wuebbena  Phi1 / l1 - Phi2 / l2 - (l2 - l1) / (l2 + l1) (P1 / l1 + P2 / l2) = N1 - N2

The last has neither geometry nor clocks nor atmosphere: what is left are N1 - N2, delays of the receivers and noise.

Source: Hatch (1982), The synergism of GPS code and carrier measurements; Melbourne (1985); Wuebbena (1985).
"""

from __future__ import annotations

import numpy as np

from factorgraph.types import Array


def ionosphere_free(l1_m: Array, l2_m: Array) -> tuple[Array, Array]:
    """Factors of first and second observation; their sum is 1. The noise of equals grows by their root sum of squares."""
    apart = l2_m**2 - l1_m**2
    return l2_m**2 / apart, -(l1_m**2) / apart


def wide_lane_m(l1_m: Array, l2_m: Array) -> Array:
    """Wavelength of the wide lane; negative where the second carrier is the shorter one."""
    return np.asarray(l1_m * l2_m / (l2_m - l1_m))


def melbourne_wuebbena(phase1_m: Array, phase2_m: Array, code1_m: Array, code2_m: Array, l1_m: Array, l2_m: Array) -> Array:
    """N1 - N2 in cycles, but for delays of the receivers; all in metres."""
    return np.asarray(phase1_m / l1_m - phase2_m / l2_m - (l2_m - l1_m) / (l2_m + l1_m) * (code1_m / l1_m + code2_m / l2_m))
