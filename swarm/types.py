"""Array aliases and callables of this room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Cost = Callable[[Array], Array]  # points (k, n) to costs (k,)


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a search stands after a population."""

    n_evals: int  # points evaluated so far
    cost: float  # best one met
    x: Array  # (n,) where; a copy


Callback = Callable[[Progress], bool | None]  # True stops the search
