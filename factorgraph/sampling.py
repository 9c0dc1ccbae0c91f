"""Tables at other times. Solutions with IMUs have their own way, interpolation."""

from __future__ import annotations

import numpy as np

from factorgraph.types import Array


def interpolate(t_s: Array, t_data: Array, x: Array) -> Array:
    """Columns of x (n, m) at t_s, linear, constant beyond the ends; rows with NaN are passed over."""
    ok = np.all(np.isfinite(x), axis=1)
    return np.column_stack([np.interp(t_s, t_data[ok], x[ok, j]) for j in range(x.shape[1])])
