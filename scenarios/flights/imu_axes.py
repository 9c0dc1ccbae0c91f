"""Which way an IMU looks: its axes against gravity, the direction of travel, and each other.

Three things are known of a level vehicle that moves forward: its specific force points up on average, its velocity forward,
and a rotation carries what the IMU feels to what fixes see (`scenarios.flights.motion_match`). The third fails where the
gyroscope has other axes, signs or units than the accelerometer; all 48 signed permutations of its columns are then tried.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from factorgraph.attitude import matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.measurements import ImuStream
from factorgraph.types import Array, IntArray
from scenarios.flights.motion_match import Carried, Steps, carry, evidence, gyro_bias, mirror_misfits, part, rotations, rows_at
from scenarios.flights.schema import Imu, axes_matrix

LETTERS = ("R", "F", "U"), ("L", "B", "D")
UPRIGHT = 0.7  # share of the mean specific force along the up axis
MOVING_MPS = 2.0
TOLD_M2S2 = 2.0  # a window's heading counts when its velocity changes so much
ALIGNED = 0.9  # length of the mean of unit vectors that agree
MIN_WINDOWS, MIN_STEPS = 4, 30
TURNED_RAD = 1.0  # of the course, without which a heading error cannot be told from a crosswind
TRIED_WINDOWS, BESIDE_S = 16, 0.5
CHOSEN = 6  # readings looked at closely
SURE = 4.0  # evidence
BETTER = 0.7  # of the misfit is left


def axis_name(direction: Array) -> str:
    """The nearest of R, F, U and their opposites L, B, D to a vector (3,) in the body."""
    k = int(np.argmax(np.abs(direction)))
    return LETTERS[int(direction[k] < 0)][k]


def gravity_doubt(stream: ImuStream, imu: Imu) -> str:
    """What is doubtful of the axes along which an IMU feels gravity; empty where nothing is."""
    mean = stream.f_b.mean(axis=0)
    unit = mean / np.linalg.norm(mean)
    if unit[2] >= UPRIGHT:
        return ""
    share = np.max(np.abs(unit))
    text = f"the accelerometers feel gravity along {axis_name(unit)} ({share:.0%}; the up axis carries {unit[2]:.0%})"
    return f'{text} with axes = "{imu.axes}"{likely_axes(imu, imu.C_bs.T @ unit)}'


def likely_axes(imu: Imu, up_s: Array, forward_s: Array | None = None) -> str:
    """Axes that fit where the columns see up and forward (unit vectors in the columns' axes)."""
    usual = ("RFU", "FRD", "FLU")
    if forward_s is None:
        fits = [axes for axes in usual if (imu.mounting.C @ axes_matrix(axes) @ up_s)[2] > 0.8]
    else:
        right_s = np.cross(forward_s, up_s)
        C = imu.mounting.C.T @ np.array([right_s, forward_s, up_s])
        name = "".join(axis_name(column) for column in C.T)
        fits = [name] if np.max(np.abs(C), axis=0).min() > 0.8 and _is_right_handed(name) else []
    if fits:
        return "; " + " or ".join(f'"{axes}"' for axes in fits) + " would fit"
    column = int(np.argmax(np.abs(up_s)))
    sign = "minus " if up_s[column] < 0 else ""
    seen = ", ".join(f"{x:+.2f}" for x in up_s)
    return f"; up is along {sign}accel[{column}] ({seen}), so check axes and mounting"


def _is_right_handed(axes: str) -> bool:
    try:
        axes_matrix(axes)
    except InputError:
        return False
    return True


def travel_doubt(steps: Steps, carried: Carried, offset_s: float, stream: ImuStream, imu: Imu) -> str:
    """What is doubtful of a vehicle's forward axis, where it moves one way in its body and the flight tells which; or empty."""
    R, told = rotations(steps, carried, offset_s)
    window = steps.window
    speed = np.linalg.norm(steps.v_n, axis=1)
    course = np.arctan2(steps.v_n[:, 0], steps.v_n[:, 1])
    use = (speed > MOVING_MPS) & (np.nan_to_num(told) > TOLD_M2S2)[window]
    if use.sum() < MIN_STEPS or len(np.unique(window[use])) < MIN_WINDOWS or np.ptp(np.unwrap(course[use])) < TURNED_RAD:
        return ""
    C = matrix_from_quat(carried.q[rows_at(carried, steps.t_s.mean(axis=1) + offset_s)])
    v_b = np.einsum("kji,kj->ki", R[window] @ C, steps.v_n)[use] / speed[use, None]
    mean = v_b.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < ALIGNED or mean[1] > UPRIGHT * length:
        return ""
    up = stream.f_b.mean(axis=0)
    forward_s, up_s = imu.C_bs.T @ (mean / length), imu.C_bs.T @ (up / np.linalg.norm(up))
    return (
        f'it travels along its {axis_name(mean)} axis ({length:.0%} of the way) with axes = "{imu.axes}"'
        f"{likely_axes(imu, up_s, forward_s)}; if it does move like that, nothing is wrong"
    )


@dataclasses.dataclass(frozen=True, slots=True)
class _Reading:
    """Another way to read the gyroscope's columns, w -> change w, and whether the force is then a mirror image."""

    change: Array  # (3, 3)
    is_mirrored: bool

    @property
    def n_changes(self) -> int:
        """Columns that change; the force is mirrored by other columns of the accelerometer, the opposites of `change`."""
        return int(np.sum(np.any((-self.change if self.is_mirrored else self.change) != np.eye(3), axis=1)))

    @property
    def is_possible(self) -> bool:
        """Whether columns can be so wrong: what mirrors the force leaves the gyroscope right-handed."""
        return not self.is_mirrored or bool(np.linalg.det(self.change) > 0 and np.max(np.abs(self.change)) == 1)

    def describe(self) -> str:
        scale = float(np.max(np.abs(self.change)))
        if scale != 1.0:
            right, wrong = ("deg/s", "rad/s") if scale < 1 else ("rad/s", "deg/s")
            return f'the gyroscope fits the motion in {right}, not in {wrong}: gyro_unit = "{right}"?'
        sensor = "accel" if self.is_mirrored else "gyro"
        columns = ", ".join(_column(sensor, row) for row in (-self.change.T if self.is_mirrored else self.change))
        return f"the motion fits when the columns of {sensor} are read as ({columns}): signs, order or axes of it are wrong"


def _column(sensor: str, row: Array) -> str:
    k = int(np.argmax(np.abs(row)))
    return f"{'-' if row[k] < 0 else ''}{sensor}[{k}]"


def _changes() -> list[Array]:
    """Other columns of the gyroscope (3, 3): as declared first, then other units, then signed permutations."""
    permuted = [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
    return [*(np.eye(3) * factor for factor in (1.0, np.pi / 180, 180 / np.pi)), *permuted[1:]]


def reading_doubt(steps: Steps, stream: ImuStream, imu: Imu, offset_s: float) -> str:
    """Another reading of the columns of the IMU that fits the motion where the declared one does not; or empty.

    Of readings that the flight cannot tell apart, the one with the fewest changes.
    """
    steps = _most_accelerated(steps, stream, offset_s)
    if len(steps.start) <= MIN_WINDOWS:
        return ""
    steps, stream = _together(steps, stream, offset_s)
    n, offset = np.diff(steps.start), np.array([offset_s])
    turned = [dataclasses.replace(stream, w_b=stream.w_b @ (imu.C_bs @ c @ imu.C_bs.T).T) for c in _changes()]
    readings = [_Reading(change, is_mirrored) for change in _changes() for is_mirrored in (False, True)]
    quick = np.array([_totals(n, mirror_misfits(steps, carry(w, np.zeros(3)), offset)) for w in turned]).ravel()
    quick[[not reading.is_possible for reading in readings]] = np.inf
    chosen = [0, *(i for i in np.argsort(quick)[:CHOSEN].tolist() if i)]
    found = [np.log(_with_bias(steps, turned[i // 2], offset_s)[i % 2][:, 0]) for i in chosen]
    best = min(found, key=lambda x: float(np.nansum(n * x)))
    alike = [i for i, x in zip(chosen, found, strict=True) if evidence(np.nan_to_num(n * (x - best))) < SURE]
    left = float(np.exp(np.nanmean(best - found[0])))
    return readings[min(alike, key=lambda i: readings[i].n_changes)].describe() if 0 not in alike and left < BETTER else ""


def _totals(n: IntArray, J: tuple[Array, Array]) -> list[float]:
    return [float(np.nansum(n * np.log(j[:, 0]))) for j in J]


def _with_bias(steps: Steps, stream: ImuStream, offset_s: float) -> tuple[Array, Array]:
    """Misfits with the bias of the gyroscope that fits best."""
    bias = gyro_bias(steps, carry(stream, np.zeros(3)), offset_s)
    return mirror_misfits(steps, carry(stream, bias), np.array([offset_s]))


def _most_accelerated(steps: Steps, stream: ImuStream, offset_s: float) -> Steps:
    """Of the windows that the IMU covers, those in which fixes see the horizontal velocity change most."""
    first, last = _spans(steps, stream, offset_s)
    size = np.add.reduceat(np.sum(steps.y[:, :2] ** 2, axis=1), steps.start[:-1])
    size[(first < 1) | (last >= len(stream.t_s))] = 0.0
    return part(steps, (size > 0) & (size >= np.sort(size)[-min(TRIED_WINDOWS, len(size))]))


def _spans(steps: Steps, stream: ImuStream, offset_s: float) -> tuple[IntArray, IntArray]:
    """First samples and those after the last in and just beside each window."""
    begin, end = steps.t_s[steps.start[:-1], 0], steps.t_s[steps.start[1:] - 1, -1]
    return np.searchsorted(stream.t_s, begin + offset_s - BESIDE_S), np.searchsorted(stream.t_s, end + offset_s + BESIDE_S)


def _together(steps: Steps, stream: ImuStream, offset_s: float) -> tuple[Steps, ImuStream]:
    """The windows and their samples alone, moved together in time, so that little is left to cumulate."""
    first, last = _spans(steps, stream, offset_s)
    rows = np.concatenate([np.arange(a, b) for a, b in zip(first, last, strict=True)])
    begin, end = stream.t_s[first], stream.t_s[last - 1]
    shift = np.concatenate([[0.0], np.cumsum(end - begin + 1.0)[:-1]]) - begin
    t_s = stream.t_s[rows] + np.repeat(shift, last - first)
    moved = dataclasses.replace(steps, t_s=steps.t_s + shift[steps.window, None])
    return moved, dataclasses.replace(stream, t_s=t_s, f_b=stream.f_b[rows], w_b=stream.w_b[rows])
