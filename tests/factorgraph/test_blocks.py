"""Measurement blocks: every Jacobian against central differences through GTSAM's own perturbations.

A step fits its variable: 10 m where satellites are 2e7 m away, 1 cm where tags are 30 m apart (style: errors of truncation
and of rounding both far below the tolerance).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest

from factorgraph.assembly import integers
from factorgraph.assembly.blocks import CODE, PHASE, Block, GnssBlock, PositionBlock
from factorgraph.assembly.build import (
    GnssLink,
    absolute_block,
    joint_blocks,
    link_block,
    motion_block,
    position_blocks,
    range_blocks,
)
from factorgraph.assembly.keys import dimension
from factorgraph.assembly.optimizer import Graph
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.variables import VehicleVariables, key
from factorgraph.attitude import exp_so3
from factorgraph.gpstime import GpsTime
from factorgraph.graphs.engine import GtsamEngine
from factorgraph.measurements import Calibration, GnssStream, HeightStream, ImuStream, PositionStream, RangeStream, Tag
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.receivers import receivers
from factorgraph.problem import (
    AmbiguitySettings,
    Antenna,
    ImuCalibration,
    Link,
    NavigationProblem,
    RangeModel,
    Robust,
    Settings,
    Vehicle,
)
from factorgraph.types import Array
from tests.factorgraph.synthetic import FRAME, every, receiver

GRID = np.arange(5.0)
SATELLITES = ("G01", "G02", "G03", "G04", "G05", "G06", "E11", "E12", "E13")
LEVER = {"a": (0.3, -1.2, 0.8), "b": (-0.2, 0.9, 0.4)}
PLACE_N = {"a": np.array([20.0, -30.0, 12.0]), "b": np.array([48.0, -21.0, 25.0])}
STEP = {
    "x": (3e-3, 0.01),
    "p": (0.01,),
    "v": (0.02,),
    "b": (1e-2, 1e-3),
    "a": (1.0,),
    "i": (1.0,),
    "l": (0.1,),
    "c": (1e-3,),
}  # halves of the columns
GNSS_STEP = STEP | {"x": (3e-3, 10.0), "p": (10.0,), "v": (1.0,), "l": (1.0,), "c": (0.03,)}
# left out of Jacobians on purpose: the Earth's rate times the time since the state, second order in bias changes
CARRIED = 1e-3
MODES = ("imu", "motion", "fixed")


def observed(name: str, offset_s: float) -> GnssStream:
    """Epochs at the grid plus an offset; two bands of one constellation, one of another."""
    t = GRID[:-1] + offset_s
    rows = [r for r in every(len(t), SATELLITES, ("G1C", "G2W", "E1C")) if r[1][0] == r[2][0]]
    r_n = PLACE_N[name] + np.outer(t, [8.0, 15.0, 1.0])
    return receiver(t, rows, r_n=r_n, v_n=np.tile([8.0, 15.0, 1.0], (len(t), 1)), clock_m=25.0)


def vehicle(name: str, mode: str, offset_s: float) -> Vehicle:
    rng = np.random.default_rng(ord(name))
    t = np.arange(-2, 220) / 50.0
    imu = ImuStream(t, rng.normal(0, 1, (len(t), 3)) + [0, 0, 9.8], rng.normal(0.1, 0.3, (len(t), 3)), True)
    at = GRID[:-1] + offset_s
    n = len(at)
    return Vehicle(
        name,
        imu=imu if mode == "imu" else None,
        gnss=Antenna(observed(name, offset_s), LEVER[name]),
        positions=(PositionStream(at, rng.normal(0, 30, (n, 3)), rng.uniform(0.5, 2, (n, 3)), LEVER[name]),),
        heights=(HeightStream(np.sort(rng.uniform(0, 4, 9)), rng.normal(10, 3, 9), np.full(9, 0.7), LEVER[name]),),
        fixed_n=tuple(PLACE_N[name].tolist()) if mode == "fixed" else None,
    )


def variables(index: int, v: Vehicle) -> VehicleVariables:
    """States about the truth, biases away from those preintegrated at."""
    rng = np.random.default_rng(100 + index)
    out = VehicleVariables(index, v, GRID, FRAME)
    if v.is_fixed:
        return out
    out.r = PLACE_N[v.name] + np.outer(GRID, [8.0, 15.0, 1.0]) + rng.normal(0, 1.0, (5, 3))
    out.v = np.array([8.0, 15.0, 1.0]) + rng.normal(0, 1.0, (5, 3))
    out.R = exp_so3(rng.normal(0, 1.0, (5, 3)))
    out.bias = rng.normal(0, 1.0, (5, 6)) * [0.01, 0.01, 0.01, 0.1, 0.1, 0.1]
    out.preintegrated_bias = out.bias + rng.normal(0, 1.0, (5, 6)) * [1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01]
    return out


def problem_of(modes: tuple[str, str], offset_s: float = 0.0) -> tuple[NavigationProblem, dict[str, VehicleVariables]]:
    """Reference a and rover b."""
    vehicles = tuple(vehicle(name, mode, offset_s) for name, mode in zip("ab", modes, strict=True))
    settings = Settings(ambiguity=AmbiguitySettings(min_arc_epochs=2), ionosphere_step_s=2.0)
    problem = NavigationProblem("blocks", GpsTime(2300, 0.0), FRAME, vehicles, (Link("a", "b"),), settings=settings)
    return problem, {v.name: variables(i, v) for i, v in enumerate(vehicles)}


def letter_of(key: int) -> str:
    return chr(gtsam.symbolChr(key))


@dataclass(frozen=True)
class Nudge:
    """A step of one variable alone."""

    key: int
    by: Array

    def step(self, keys: Sequence[int]) -> Array:
        return np.array([self.by if key == self.key else np.zeros(dimension(key)) for key in keys])


def evaluated(
    ends: dict[str, VehicleVariables], blocks: list[Block], parameters: Parameters | None = None, seed: int = 0
) -> Graph:
    """A graph of these blocks at its values, with robust weights that differ from row to row."""
    gnss = [b for b in blocks if isinstance(b, GnssBlock)]
    graph = Graph(list(ends.values()), GtsamEngine(), blocks, gnss, parameters or Parameters())
    graph.assemble()
    graph.predict()
    rng = np.random.default_rng(seed)
    for block in blocks:
        block.w = rng.uniform(0.2, 1.0, block.n)
        block.whiten()
    return graph


def assert_jacobians(graph: Graph, block: Block, steps: dict[str, tuple[float, ...]], tolerance: float = 5e-5) -> None:
    """Columns of every factor against central differences of its whitened rows, relative to the largest of each key's."""
    base = graph.values()
    factors = range(len(block.rows.factor.start))
    assert len(factors)
    analytic = [(keys, [c.copy() for c in columns]) for keys, columns in (block.columns(f) for f in factors)]
    tried = set()
    for f, (keys, columns) in zip(factors, analytic, strict=True):
        i, j = block.slices(f)
        assert len(keys) == len(columns)
        for k, J in zip(keys, columns, strict=True):
            letter = letter_of(k)
            tried.add(letter)
            n = J.shape[1]
            size = np.repeat(steps[letter], n // len(steps[letter]))
            numeric = np.zeros_like(J)
            for column in range(n):
                rows = []
                for sign in (1.0, -1.0):
                    graph.take(base)
                    graph.move(Nudge(k, sign * size[column] * np.eye(n)[column]))  # type: ignore[arg-type]
                    block.whiten()
                    rows.append(block.e[i:j].copy())
                numeric[:, column] = (rows[0] - rows[1]) / (2 * size[column])
            # rounding of 2e7 m in a row of a few millimetres' sigma is the floor
            bound = tolerance * np.abs(J * size).max() + 1e-6
            assert np.abs((numeric - J) * size).max() < bound, (
                f"factor {f}, {letter}: {np.abs((numeric - J) * size).max():.2g} against {bound:.2g}"
            )
    graph.take(base)
    block.whiten()
    assert tried


def link_of(problem: NavigationProblem, ends: dict[str, VehicleVariables]) -> GnssLink:
    data = link_block(problem, problem.links[0], ends, receivers(problem), 0, True, Parameters())
    integers.start_ambiguities(data)
    return data


# -- Jacobians -------------------------------------------------------------------------------------


@pytest.mark.parametrize("modes", [("imu", "imu"), ("motion", "imu"), ("fixed", "imu"), ("imu", "motion"), ("fixed", "motion")])
@pytest.mark.parametrize("offset_s", [0.0, 0.4])
def test_differences_of_code_phase_and_doppler(modes: tuple[str, str], offset_s: float) -> None:
    """On the grid and 0.4 s off it, where preintegration carries the antennas and biases come in."""
    problem, ends = problem_of(modes, offset_s)
    block = link_of(problem, ends).block
    graph = evaluated(ends, [block])
    letters = {letter_of(k) for f in range(4) for k in block.columns(f)[0]}
    assert "a" in letters and ("b" in letters) == (offset_s > 0 and "imu" in modes)
    assert set(block.rows.kind.tolist()) == {0, 1, 2}
    assert_jacobians(graph, block, GNSS_STEP, CARRIED if offset_s else 5e-5)


@pytest.mark.parametrize("mode", ["imu", "motion"])
@pytest.mark.parametrize("offset_s", [0.0, 0.4])
def test_undifferenced_code_and_doppler(mode: str, offset_s: float) -> None:
    problem, ends = problem_of(("fixed", mode), offset_s)
    block = absolute_block(problem, ends["b"], receivers(problem)["b"], Parameters())
    assert block is not None
    assert_jacobians(evaluated(ends, [block]), block, GNSS_STEP, CARRIED)


@pytest.mark.parametrize("mode", ["imu", "motion"])
@pytest.mark.parametrize("offset_s", [0.0, 0.4])
def test_positions_and_heights(mode: str, offset_s: float) -> None:
    _, ends = problem_of(("fixed", mode), offset_s)
    position, height = position_blocks(ends["b"], Parameters())
    graph = evaluated(ends, [position, height])
    assert position.n == 12 and height.n == 9
    for block in (position, height):
        assert_jacobians(graph, block, STEP, CARRIED)


def ranges_between(t: Array, anchors: bool) -> RangeModel:
    tags = (
        Tag("a1", "a", LEVER["a"]),
        Tag("b1", "b", LEVER["b"]),
        Tag("b2", "b", (0.0, 1.0, 0.0)),
        Tag("x", position_n=(5.0, 60.0, -3.0)),
    )
    first, second = (
        (np.full(len(t), 3), 1 + np.arange(len(t)) % 2) if anchors else (np.zeros(len(t), int), 1 + np.arange(len(t)) % 2)
    )
    return RangeModel(
        RangeStream(t, first, second, tags, np.full(len(t), 30.0), np.full(len(t), 0.1)), bias_sigma_m=0.3, scale_sigma=0.01
    )


@pytest.mark.parametrize("modes", [("imu", "imu"), ("motion", "imu"), ("fixed", "motion")])
@pytest.mark.parametrize("anchors", [True, False])
def test_ranges_with_bias_and_scale(modes: tuple[str, str], anchors: bool) -> None:
    """Both ends with lever arms, between states; the anchor named first is still the far end."""
    _, ends = problem_of(modes)
    t = np.sort(np.random.default_rng(1).uniform(0, 4, 12))
    parameters = Parameters()
    (block,) = range_blocks(ranges_between(t, anchors), ends, parameters)
    parameters.of_name["uwb bias"].value[:] = 0.2
    parameters.of_name["uwb scale"].value[:] = 0.03
    graph = evaluated(ends, [block], parameters)
    assert block.n == 12 and letter_of(block.keys(0)[-1]) == "c"
    assert_jacobians(graph, block, STEP, CARRIED)


# -- lever arms and time offsets --------------------------------------------------------------------


def calibrated(v: Vehicle) -> Vehicle:
    """The vehicle with everything about its sensors' places and clocks to be estimated."""
    every_one = Calibration(lever_m=0.5, time_s=0.05)
    return replace(
        v,
        gnss=replace(v.gnss, calibration=every_one) if v.gnss else None,
        positions=tuple(replace(p, calibration=every_one) for p in v.positions),
        heights=tuple(replace(h, calibration=Calibration(time_s=0.05, bias=1.0)) for h in v.heights),
        imu_calibration=ImuCalibration(time_s=0.05),
    )


def calibrated_problem(offset_s: float) -> tuple[NavigationProblem, dict[str, VehicleVariables], Parameters]:
    """Two vehicles with IMU and an estimated time offset of it, values away from zero."""
    problem, _ = problem_of(("imu", "imu"), offset_s)
    problem = replace(problem, vehicles=tuple(calibrated(v) for v in problem.vehicles))
    ends = {v.name: variables(i, v) for i, v in enumerate(problem.vehicles)}
    parameters = Parameters()
    for end in ends.values():
        end.imu_offset = parameters.scalar(f"{end.name} imu", "s", 0.05)
    return problem, ends, parameters


def assert_calibration_jacobians(
    ends: dict[str, VehicleVariables], block: Block, parameters: Parameters, steps: dict[str, tuple[float, ...]], letters: str
) -> None:
    rng = np.random.default_rng(4)
    for p in parameters:
        p.value = rng.normal(0, 0.3 if p.unit == "m" else 0.002, len(p.value))
    graph = evaluated(ends, [block], parameters)
    assert set(letters) <= {letter_of(k) for k in block.keys(0)}
    # second order, left out: what a late time changes of the columns of attitude and bias
    assert_jacobians(graph, block, steps, 2e-2)


@pytest.mark.parametrize("offset_s", [0.0, 0.4])
def test_levers_and_time_offsets_of_differences(offset_s: float) -> None:
    problem, ends, parameters = calibrated_problem(offset_s)
    data = link_block(problem, problem.links[0], ends, receivers(problem), 0, True, parameters)
    assert_calibration_jacobians(ends, data.block, parameters, GNSS_STEP, "xvlc")


@pytest.mark.parametrize("offset_s", [0.0, 0.4])
def test_levers_and_time_offsets_of_positions_and_heights(offset_s: float) -> None:
    _, ends, parameters = calibrated_problem(offset_s)
    position, height = position_blocks(ends["b"], parameters)
    assert_calibration_jacobians(ends, position, parameters, STEP, "xvlc")
    assert_calibration_jacobians(ends, height, parameters, STEP, "xvc")


def test_levers_and_one_time_offset_of_ranges() -> None:
    """Both ends share the set's time offset: its column is one."""
    _, ends, parameters = calibrated_problem(0.0)
    t = np.sort(np.random.default_rng(1).uniform(0.5, 3.5, 12))
    model = replace(ranges_between(t, False), lever_sigma_m=0.2, time_sigma_s=0.02, per_pair=True)
    blocks = range_blocks(model, ends, parameters)
    assert len(blocks) == 2 and blocks[0].bias is not blocks[1].bias
    for block in blocks:
        keys = block.keys(0)
        assert len(set(keys)) == len(keys)
        assert_calibration_jacobians(ends, block, parameters, STEP, "xvlc")


def test_points_move_to_other_states_with_a_time_offset() -> None:
    """0.3 s late at 0.1 s after a state: the state before carries the fix, at the time it was taken."""
    _, ends, parameters = calibrated_problem(0.1)
    position, _ = position_blocks(ends["b"], parameters)
    assert isinstance(position, PositionBlock)
    before, keys = position.end.query.k.copy(), position.keys(2)
    t = GRID[before] + position.end.query.dt_s
    parameters.of_name["b/position time offset"].value[:] = 0.3
    position.refresh()
    after = position.end.query
    np.testing.assert_allclose(GRID[after.k] + after.dt_s, t - 0.3, atol=1e-9)
    assert np.all(after.k[1:] == before[1:] - 1) and position.keys(2) != keys


def test_motion_prior() -> None:
    _, ends = problem_of(("fixed", "motion"))
    motion = motion_block(ends["b"])
    assert_jacobians(evaluated(ends, [motion]), motion, STEP)


# -- what rows mean --------------------------------------------------------------------------------


def test_factors_hand_out_the_blocks_rows() -> None:
    """What GTSAM linearises is what the block computed: errors, Jacobians and their keys."""
    problem, ends = problem_of(("imu", "imu"), 0.4)
    parameters = Parameters()
    (ranges,) = range_blocks(ranges_between(np.array([0.5, 1.5, 2.6]), False), ends, parameters)
    blocks: list[Block] = [link_of(problem, ends).block, ranges, *position_blocks(ends["b"], parameters)]
    graph = evaluated(ends, blocks, parameters)
    linear = graph.engine.linearise(graph, joints=False).linear  # type: ignore[attr-defined]
    index = 0
    for block in blocks:
        for f in range(len(block.rows.factor.start)):
            factor = linear.at(index)
            i, j = block.slices(f)
            keys, columns = block.columns(f)
            assert list(factor.keys()) == keys
            A, b = factor.getA(), factor.getb()  # type: ignore[attr-defined]
            np.testing.assert_allclose(A, np.hstack(columns), atol=1e-12)
            np.testing.assert_allclose(b, -block.e[i:j], atol=1e-12)
            index += 1
    assert index == linear.size()


def test_a_common_clock_moves_no_residual() -> None:
    """Metres on every row of one clock: the graph does not see them; on one row it does."""
    problem, ends = problem_of(("imu", "imu"))
    block = link_of(problem, ends).block
    evaluated(ends, [block])
    before = block.e.copy()
    clocks = block.rows.clocks
    assert clocks is not None
    block.z = block.z + np.random.default_rng(0).normal(0, 100.0, len(clocks.start))[clocks.of_row]
    block.predict()
    block.whiten()
    np.testing.assert_allclose(block.e, before, atol=1e-4)
    block.z[0] += 1.0
    block.predict()
    block.whiten()
    assert np.abs(block.e - before).max() > 0.5


def test_clocks_are_one_per_epoch_kind_and_signal() -> None:
    problem, ends = problem_of(("imu", "imu"))
    rows = link_of(problem, ends).block.rows
    assert rows.clocks is not None
    label = list(zip(rows.factor.of_row.tolist(), rows.kind.tolist(), rows.group_index.tolist(), strict=True))
    assert len(set(label)) == len(rows.clocks.start) == 4 * 3 * 3
    for group in range(len(rows.clocks.start)):
        assert len({label[i] for i in np.flatnonzero(rows.clocks.of_row == group)}) == 1
    assert {rows.group[g][0] for g in rows.group_index} == {"G", "E"}


def test_integers_shift_phases_by_wavelengths() -> None:
    """An ambiguity raised by a cycle is as an observation lowered by a wavelength; codes do not move."""
    problem, ends = problem_of(("imu", "imu"))
    block = link_of(problem, ends).block
    evaluated(ends, [block])
    before = block.y.copy()
    block.amb_value[3] += 1.0
    block.predict()
    mine = (block.arc == 3) & (block.rows.kind == PHASE)
    np.testing.assert_allclose(block.y - before, np.where(mine, -block.wavelength_m, 0.0), atol=1e-9)


def test_constant_ambiguities_have_no_column() -> None:
    problem, ends = problem_of(("imu", "imu"))
    block = link_of(problem, ends).block
    n = len(block.amb_key)
    free = int(np.sum(block.amb_key != 0))
    assert n - free == 3  # one datum per clock group
    names = [k for k in block.columns(0)[0] if letter_of(k) == "a"]
    assert len(names) == free and set(names) == set(block.amb_key[block.amb_key != 0].tolist())
    block.amb_key[:] = 0
    block.renew()
    evaluated(ends, [block])
    assert not [k for k in block.columns(0)[0] if letter_of(k) == "a"]
    assert len(block.columns(0)[1]) == len(block.keys(0)) == 4


def test_exact_observations_leave_nothing() -> None:
    """Antennas at rest on the points observed from: code, phase and Doppler of the hand-made sky vanish but for troposphere."""
    problem, ends = problem_of(("motion", "motion"))
    for name, v in ends.items():
        v.r, v.v = PLACE_N[name] + np.outer(GRID, [8.0, 15.0, 1.0]), np.tile([8.0, 15.0, 1.0], (5, 1))
    block = link_of(problem, ends).block
    evaluated(ends, [block])
    assert np.abs(block.residuals()).max() < 0.02  # 13 m of height between the antennas
    np.testing.assert_allclose(block.amb_value, 0.0, atol=0.5)


def test_normalised_residuals_have_unit_variance() -> None:
    """Noise of each row's own sigma, its clock taken out by the same rows: leverage is accounted for."""
    problem, ends = problem_of(("imu", "imu"))
    block = link_of(problem, ends).block
    evaluated(ends, [block])
    block.w = np.ones(block.n)
    rng = np.random.default_rng(3)
    samples = []
    for _ in range(3000):
        block.y = rng.normal(0.0, 1.0, block.n) * block.rows.sigma + 50.0
        samples.append(block.normalised())
    np.testing.assert_allclose(np.std(samples, axis=0), 1.0, atol=0.07)


def test_normalised_residual_of_an_outlier_is_its_own() -> None:
    """One code 20 sigma off among others without noise: its share of the common clock does not hide it."""
    problem, ends = problem_of(("imu", "imu"))
    block = link_of(problem, ends).block
    evaluated(ends, [block])
    block.w = np.ones(block.n)
    block.y = np.zeros(block.n)
    block.y[1] = 20 * block.rows.sigma[1]
    t = block.normalised()
    assert np.argmax(np.abs(t)) == 1
    h = CommonGroups.leverage(block.rows.clocks, 1 / block.rows.sigma)[1]  # type: ignore[arg-type]
    assert abs(t[1] - 20 * np.sqrt(1 - h)) < 1e-9


def test_inactive_rows_count_nowhere() -> None:
    _, ends = problem_of(("fixed", "imu"))
    position, _ = position_blocks(ends["b"], Parameters())
    evaluated(ends, [position])
    position.w = np.ones(position.n)
    all_of_it = position.cost({})
    position.active[4] = False
    position.reweight({})
    position.whiten()
    assert position.w[4] == 0.0 and not np.any(position.Jw[4]) and position.e[4] == 0.0
    assert abs(all_of_it - position.cost({}) - 0.5 * (position.y[4] / position.rows.sigma[4]) ** 2) < 1e-9 * all_of_it


def test_joint_rows_carry_no_information() -> None:
    _, ends = problem_of(("imu", "motion"))
    [block] = joint_blocks([(ends["a"], ends["b"]), (ends["b"], ends["a"]), (ends["a"], ends["a"])])
    evaluated(ends, [block])
    assert not np.any(block.e) and not np.any(block.Jw)
    assert block.keys(2) == [key("x", 0, 2), key("v", 0, 2), key("p", 1, 2), key("v", 1, 2)]


def test_vehicles_that_pairs_connect_share_joint_rows() -> None:
    v = [VehicleVariables(i, Vehicle(name), np.arange(4.0), FRAME) for i, name in enumerate("abcdef")]
    base = VehicleVariables(6, Vehicle("base", fixed_n=(0.0, 0.0, 0.0)), np.arange(4.0), FRAME)
    blocks = joint_blocks([(v[0], v[1]), (v[2], v[3]), (v[1], v[4]), (base, v[5]), (v[4], v[0])])
    assert sorted(sorted(end.name for end in block.vehicles) for block in blocks) == [["a", "b", "e"], ["c", "d"]]
    assert len(blocks[1].keys(3)) == 2 * len(blocks[1].vehicles)


def test_errors_that_last_are_judged_row_by_row_and_weigh_together() -> None:
    """With a persistence p, sigma is p times a row's own: weights as for single rows, cost and information 1 / p^2 of theirs."""
    problem, ends = problem_of(("motion", "motion"))
    block = link_of(problem, ends).block
    evaluated(ends, [block])
    robust = {"code": Robust("dcs", 2.5), "doppler": Robust("huber", 2.0)}
    block.w = np.ones(block.n)
    block.reweight(robust)
    w, cost, t = block.w.copy(), block.cost(robust), block.normalised()
    block.whiten()
    e = block.e.copy()
    block.rows.persistence = np.full(block.n, 7.0)
    block.rows.sigma = 7.0 * block.rows.sigma
    block.w = np.ones(block.n)
    block.reweight(robust)
    np.testing.assert_allclose(block.w, w, rtol=1e-12)
    np.testing.assert_allclose(block.normalised(), t, rtol=1e-9)
    assert abs(block.cost(robust) * 49 / cost - 1) < 1e-9
    block.whiten()
    np.testing.assert_allclose(block.e, e / 7, rtol=1e-9, atol=1e-12)


def test_medians_keep_losses_that_reject_outright_from_rejecting_all() -> None:
    """Two gross codes of six draw the mean clock off by twenty sigma; afresh, only they are rejected."""
    problem, ends = problem_of(("motion", "motion"))
    block = link_of(problem, ends).block
    evaluated(ends, [block])
    clocks = block.rows.clocks
    assert clocks is not None
    first = np.flatnonzero((block.rows.kind == CODE) & (np.bincount(clocks.of_row)[clocks.of_row] >= 6))[:6]
    assert len(set(clocks.of_row[first])) == 1
    block.y = np.random.default_rng(5).normal(0, 0.5, block.n) * block.rows.sigma + 300.0
    block.y[first[[1, 4]]] += 60 * block.rows.sigma[first[[1, 4]]]
    robust = {"code": Robust("tls", 4.0)}
    block.w = np.ones(block.n)
    block.reweight(robust)
    assert not np.any(block.w[first])
    block.reweight(robust, afresh=True)
    np.testing.assert_array_equal(block.w[first], [1, 0, 1, 1, 0, 1])


def test_a_group_that_lost_all_weight_may_return() -> None:
    problem, ends = problem_of(("motion", "motion"))
    block = link_of(problem, ends).block
    evaluated(ends, [block])
    block.y = np.full(block.n, 40.0)
    block.w = np.zeros(block.n)
    np.testing.assert_allclose(block.residuals(), 0.0, atol=1e-12)
    block.reweight({"code": Robust("tls", 3.0), "doppler": Robust("tukey", 3.0), "phase": Robust("dcs", 3.0)})
    np.testing.assert_array_equal(block.w, 1.0)
