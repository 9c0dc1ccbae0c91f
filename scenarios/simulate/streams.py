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
