"""Random streams: one per vehicle, sensor and error source, found by name.

A stream depends on the seed and its own name only, so adding a sensor or switching an error source on leaves every other
number as it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated
from zlib import crc32

import numpy as np
from pydantic import Field
from scipy.signal import lfilter

from factorgraph.types import Array

# of vehicles and sensors: they name random streams and files
Name = Annotated[str, Field(pattern=r"^\w[\w.-]*$")]


@dataclass(frozen=True, slots=True)
class Streams:
    """Generators below a common name, for instance "leader/gnss"."""

    seed: int
    name: str = ""

    def __truediv__(self, name: str) -> Streams:
        return Streams(self.seed, f"{self.name}/{name}")

    def __call__(self, name: str) -> np.random.Generator:
        """A fresh generator of the named stream."""
        key = crc32(f"{self.name}/{name}".encode())
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(key,)))


def gauss_markov(unit: Array, step: float) -> Array:
    """Gauss-Markov sequences (n, ...) of unit variance from white noise; `step` in correlation times.

    Exact for any step: x[k+1] = a x[k] + sqrt(1 - a^2) w, a = exp(-step). Source: spec common.md, section 4.
    """
    a = np.exp(-step)
    drive = np.sqrt(1 - a * a) * unit
    drive[0] = unit[0]
    return np.asarray(lfilter([1.0], [1.0, -a], drive, axis=0))
