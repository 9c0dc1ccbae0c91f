"""Radio ranges between tags: range = (1 + scale) true + bias + noise + excess of blocked paths (exponential)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from pydantic import Field, PositiveFloat

from factorgraph.errors import InputError
from factorgraph.measurements import RangeStream, Tag
from factorgraph.problem import RangeModel
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.flights.schema import Table, TagTable, nearest_hint
from scenarios.simulate.fixes import epochs
from scenarios.simulate.streams import Name, Streams
from scenarios.simulate.trajectory import Trajectory

Probability = Field(default=0.0, ge=0, le=1)


class RangeTable(Table):
    """A set of ranges; without `pairs`, every two tags that are not on one vehicle and not both anchors."""

    name: Name = "uwb"
    tags: tuple[TagTable, ...] = Field(min_length=2)
    pairs: tuple[tuple[str, str], ...] = ()
    rate_hz: PositiveFloat = 10.0  # of every pair
    offset_s: float = Field(default=0.0, ge=0)
    sigma_m: PositiveFloat = 0.10
    bias_m: float = 0.0
    scale_ppm: float = 0.0
    nlos_probability: float = Probability
    nlos_mean_m: PositiveFloat = 0.5
    dropout: float = Probability
    max_range_m: PositiveFloat = 1e6
    bias_sigma_m: float = Field(default=0.0, ge=0)  # what the estimator is told; each pair's spread where per_pair
    scale_sigma: float = Field(default=0.0, ge=0)
    per_pair: bool = False


@dataclass(frozen=True, slots=True)
class RangeRecord:
    """The errors put in, row by row."""

    nlos_m: Array  # (n,) excess, 0 where the path is clear
    bias_m: Array  # (n,)
    true_m: Array  # (n,)


def pairs_of(table: RangeTable) -> list[tuple[int, int]]:
    """Index pairs of tags. Raises InputError for an unknown tag or when nothing can be measured."""
    names = [tag.name for tag in table.tags]
    for name in (n for pair in table.pairs for n in pair):
        if name not in names:
            raise InputError(f"range {table.name}: no tag {name}{nearest_hint(name, names)}")
    if table.pairs:
        return [(names.index(a), names.index(b)) for a, b in table.pairs]
    found = [(i, j) for (i, a), (j, b) in combinations(enumerate(table.tags), 2) if a.vehicle != b.vehicle]
    if not found:
        raise InputError(f"range {table.name}: its tags are all on one vehicle or all anchors")
    return found


def simulate(
    table: RangeTable, trajectories: dict[str, Trajectory], duration_s: float, streams: Streams, noise_scale: float
) -> tuple[RangeModel, RangeRecord]:
    """Ranges of the whole flight, pairs taking turns; `noise_scale` multiplies every error."""
    pairs = pairs_of(table)
    tags = tuple(Tag(t.name, t.vehicle, t.lever_b, t.position_m) for t in table.tags)
    parts = [_of_pair(table, tags, k, len(pairs), pair, trajectories, duration_s, streams) for k, pair in enumerate(pairs)]
    t, a, b, true, unit_noise, nlos, bias, heard = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.flatnonzero(heard)[np.argsort(t[heard], kind="stable")]
    t, a, b, true, unit_noise, nlos, bias = (x[order] for x in (t, a, b, true, unit_noise, nlos, bias))
    record = RangeRecord(noise_scale * nlos, noise_scale * bias, true)
    noise = noise_scale * (unit_noise * table.sigma_m + true * table.scale_ppm * 1e-6)
    sigma = np.full(len(t), table.sigma_m)
    stream = RangeStream(t, a, b, tags, true + record.bias_m + record.nlos_m + noise, sigma, table.name)
    return RangeModel(stream, table.bias_sigma_m, table.scale_sigma, table.per_pair), record


def _of_pair(
    table: RangeTable,
    tags: tuple[Tag, ...],
    turn: int,
    n_pairs: int,
    pair: tuple[int, int],
    trajectories: dict[str, Trajectory],
    duration_s: float,
    streams: Streams,
) -> tuple[Array, IntArray, IntArray, Array, Array, Array, Array, BoolArray]:
    t = epochs(table.rate_hz, table.offset_s + turn / n_pairs / table.rate_hz, duration_s)
    n = len(t)
    ends = [_position(tags[k], trajectories, t) for k in pair]
    true = np.linalg.norm(ends[0] - ends[1], axis=1)
    own = streams / f"{tags[pair[0]].name}-{tags[pair[1]].name}"
    blocked = own("nlos").random(n) < table.nlos_probability
    excess = own("nlos excess").exponential(table.nlos_mean_m, n)
    bias = table.bias_m + (own("bias").normal(0.0, table.bias_sigma_m) if table.per_pair else 0.0)
    heard = (own("dropout").random(n) >= table.dropout) & (true <= table.max_range_m)
    noise = own("noise").normal(0.0, 1.0, n)
    return t, np.full(n, pair[0]), np.full(n, pair[1]), true, noise, np.where(blocked, excess, 0.0), np.full(n, bias), heard


def _position(tag: Tag, trajectories: dict[str, Trajectory], t_s: Array) -> Array:
    if tag.vehicle is None:
        return np.tile(np.asarray(tag.position_n, float), (len(t_s), 1))
    if tag.vehicle not in trajectories:
        raise InputError(f"tag {tag.name}: no vehicle {tag.vehicle}{nearest_hint(tag.vehicle, sorted(trajectories))}")
    return trajectories[tag.vehicle].at(t_s).point(tag.lever_b)[0]
