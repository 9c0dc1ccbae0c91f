"""Heights whose bias walks, as a barometer's does with the weather: z = r_U + (1 - f) b_j + f b_{j+1}.

The bias has nodes (`assembly.nodes`) so close that it walks by no more than half of a measurement's standard deviation from one
to the next. A factor holds the heights of one state interval between two nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factorgraph.assembly.atmosphere import NodeBlock, node_block
from factorgraph.assembly.blocks import HEIGHT, Endpoint, EndsBlock
from factorgraph.assembly.keys import symbol
from factorgraph.assembly.nodes import LETTER, Nodes, Process
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.rows import plain_rows, sensor_end
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.measurements import HeightStream
from factorgraph.models.differencing import CommonGroups
from factorgraph.types import Array, BoolArray, IntArray

FIRST_KEY = 1 << 40  # above those of links
KEYS_PER_STREAM, STREAMS_PER_VEHICLE = 1_000_000, 100
STEP_S = (1.0, 60.0)  # shortest and longest time between nodes
LEAST_PRIOR_M = 1e-3


@dataclass(slots=True)
class BarometerBlock(EndsBlock):
    """Up coordinates of a point with a bias that walks."""

    end: Endpoint
    z_m: Array  # (n,)
    node: IntArray  # (n,) the one before each row
    late: Array  # (n,) share of the next

    def ends(self) -> list[Endpoint]:
        return [self.end]

    def keys(self, f: int) -> list[int]:
        j = int(self.node[self.rows.factor.start[f]])
        return [*EndsBlock.keys(self, f), int(self.nodes[0].key[j]), int(self.nodes[0].key[j + 1])]

    def key_table(self) -> IntArray:
        j = self.node[self.rows.factor.start]
        return np.column_stack([EndsBlock.key_table(self), self.nodes[0].key[j], self.nodes[0].key[j + 1]])

    def widths(self) -> tuple[int, ...]:
        return (*EndsBlock.widths(self), 1, 1)

    def regroup(self) -> None:
        self.rows.factor = CommonGroups.from_labels(self.end.query.k * len(self.nodes[0].key) + self.node)

    def predict(self) -> None:
        p, b = self.end.points(velocity=False), self.nodes[0].value
        self.y = self.z_m - p.r_n[:, 2] - (1 - self.late) * b[self.node] - self.late * b[self.node + 1]
        self.J = self.columns_of.join([p.J_r[:, 2, :]], [(1 - self.late)[:, None], self.late[:, None]])


def barometer_blocks(
    end: VehicleVariables, h: HeightStream, used: BoolArray, index: int, parameters: Parameters
) -> tuple[BarometerBlock, NodeBlock]:
    """The heights of a stream, the vehicle's number `index`, where `used` (n,), and the process of their bias."""
    calibration, name = h.calibration, f"{end.name}/{h.name}"
    t, sigma = h.t_s[used], h.sigma_m[used]
    step = float(np.clip((np.median(sigma) / calibration.bias_walk) ** 2 / 4, *STEP_S))
    place = (t - t[0]) / step
    node = np.floor(place).astype(np.int64)
    n = int(node[-1]) + 2
    first = FIRST_KEY + (end.index * STREAMS_PER_VEHICLE + index) * KEYS_PER_STREAM
    keys = np.array([symbol(LETTER, first + i) for i in range(n)], np.int64)
    row, late = np.arange(len(t)), place - node
    nodes = Nodes(
        "bias",
        keys,
        t[0] + step * np.arange(n),
        np.zeros(n, np.int64),
        np.concatenate([row, row]),
        np.concatenate([node, node + 1]),
        np.concatenate([1 - late, late]),
    )
    at = sensor_end(end, t, h.lever_b, name, calibration, parameters)
    rows = plain_rows(HEIGHT, t, sigma, at.query.k * n + node, name, ["U"], np.zeros(len(t), np.int64))
    block = BarometerBlock(rows, end=at, z_m=h.up_m[used], node=node, late=late)
    block.nodes.append(nodes)
    process = Process(max(calibration.bias, LEAST_PRIOR_M), walk=calibration.bias_walk)
    return block, node_block(nodes, process, name)
