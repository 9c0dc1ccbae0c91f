"""Every block through its symbolic model: values and Jacobians against the hand-written ones and against differences.

The cases are those of the blocks' own tests, with another check in the place of theirs. Between states the hand-written
Jacobians leave out the Earth's rate and second orders of the bias on purpose, so they are compared as closely as those tests
compare them with differences; the symbolic ones are exact and compared to 1e-6.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from factorgraph import attitude
from factorgraph.assembly.blocks import Block, Endpoint, EndsBlock, GnssBlock, PositionBlock, RangeBlock
from factorgraph.assembly.build import position_blocks, range_blocks
from factorgraph.assembly.constraints import ZeroRotationBlock
from factorgraph.assembly.inertial_block import ImuBlock, imu_block
from factorgraph.assembly.optimizer import Graph
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.priors import StatePrior, motion_block, state_prior
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.graphs.engine import GtsamEngine
from factorgraph.least_squares import functions
from factorgraph.least_squares.evaluate import LINEAR, RECIPES, evaluate, evaluator
from factorgraph.least_squares.functions import Samples, compiled, linearised
from factorgraph.models.symbolic import motion, point, ranging, rotations
from factorgraph.models.symbolic.symbols import Symbols, flat, matrix
from factorgraph.problem import ImuCalibration
from factorgraph.types import Array, IntArray
from tests.factorgraph import test_blocks, test_inertial_block, test_intersystem, test_link_atmosphere, test_sensors
from tests.factorgraph.synthetic import FRAME

EXACT = 1e-6
IMU_STEP = {"x": (1e-3, 1e-2), "v": (1e-2,), "b": (1e-3, 1e-4), "l": (1e-4,)}


# -- differences of the symbolic residuals ----------------------------------------------------------


@dataclass
class Variable:
    """Variables of one kind that are moved together, by the same amount of one column; no row depends on two of them."""

    keys: IntArray
    columns: int
    letter: str
    move: Callable[[int, float], None]  # column, step


def variables_of(graph: Graph, block: Block) -> Iterator[Variable]:
    # rows of ends see one state of each, others neighbouring ones
    starts = [(0, 1)] if isinstance(block, EndsBlock) else [(0, 2), (1, 2)]
    for v, (first, step) in product(graph.vehicles, starts):
        yield from _states(v, np.arange(first, len(v.t_s), step))
    for p in graph.parameters:

        def move(column: int, step: float, p: Any = p) -> None:
            p.value = p.value + step * np.eye(len(p.value))[column]

        yield Variable(np.array([p.key]), len(p.value), "l" if len(p.value) == 3 else "c", move)
    for nodes, first in product(block.nodes, (0, 1)):

        def shift(_: int, step: float, nodes: Any = nodes, first: int = first) -> None:
            nodes.value[first::2] += step

        yield Variable(nodes.key[first::2], 1, "i", shift)


def _states(v: VehicleVariables, k: IntArray) -> Iterator[Variable]:
    def keys(slot: int) -> IntArray:
        return np.array([v.keys(int(i))[slot] for i in k])

    def pose(column: int, step: float) -> None:
        d = step * np.eye(3)[column % 3]
        if column < 3:
            v.R[k] = v.R[k] @ attitude.exp_so3(d)
        else:
            v.r[k] = v.r[k] + v.R[k] @ d

    def position(column: int, step: float) -> None:
        v.r[k] += step * np.eye(3)[column]

    def velocity(column: int, step: float) -> None:
        v.v[k] += step * np.eye(3)[column]

    def bias(column: int, step: float) -> None:
        v.bias[k, (column + 3) % 6] += step

    if v.mode == "imu":
        yield from (Variable(keys(0), 6, "x", pose), Variable(keys(1), 3, "v", velocity), Variable(keys(2), 6, "b", bias))
    elif v.mode == "motion":
        yield from (Variable(keys(0), 3, "p", position), Variable(keys(1), 3, "v", velocity))


def check(graph: Graph, block: Block, steps: dict[str, tuple[float, ...]], tolerance: float = 5e-5) -> None:
    """In the place of `assert_jacobians`: the block through its evaluator."""
    if isinstance(block, LINEAR):
        return
    rng = np.random.default_rng(3)
    is_gnss = isinstance(block, GnssBlock)
    if isinstance(block, GnssBlock):
        block.amb_value, block.jump_cyc = rng.normal(0, 100, len(block.amb_value)), rng.integers(-2, 3, block.n).astype(float)
    block.predict()
    by_hand, J_by_hand = block.y.copy(), block.J.copy()
    symbolic = evaluator(block, codegen=False)
    symbolic.evaluate()
    J = block.J.copy()
    assert block.y.shape == by_hand.shape and J.shape == J_by_hand.shape
    rounding = 2e-8 if is_gnss else 1e-11  # of 2.2e7 m
    np.testing.assert_allclose(block.y, by_hand, rtol=1e-9, atol=rounding)
    edges = block.edges()
    of_row = np.array([block.keys(f)[: len(edges)] for f in range(len(block.rows.factor.start))])[block.rows.factor.of_row]
    compared = 0
    for x in variables_of(graph, block):
        size = np.repeat(steps[x.letter], x.columns // len(steps[x.letter])) if x.columns > 1 else np.array(steps[x.letter])
        sees = np.isin(of_row, x.keys)
        rows = np.flatnonzero(sees.any(axis=1))
        analytic, hand = np.zeros((2, block.n, x.columns))
        for slot, (a, b) in enumerate(edges):
            if b - a == x.columns:
                mine = sees[:, slot]
                analytic[mine] += J[mine, a:b]
                hand[mine] += J_by_hand[mine, a:b]
        if not len(rows):
            continue
        compared += 1
        numeric = np.column_stack([_difference(symbolic, x, c, size[c]) for c in range(x.columns)])
        largest = np.abs(analytic[rows] * size).max()
        for name, other, bound in (("differences", numeric, EXACT), ("by hand", hand, tolerance)):
            error = np.abs((other - analytic)[rows] * size).max()
            assert error <= bound * largest + rounding, (
                f"{type(block).__name__}, {x.letter}, {name}: {error:.2g} of {largest:.2g}"
            )
    assert compared
    symbolic.evaluate()


def _difference(symbolic: Any, x: Variable, column: int, h: float) -> Array:
    """Derivative (n,) of predictions by a column, from four points."""
    y = {}
    at = 0
    for place in (-2, -1, 1, 2):
        x.move(column, (place - at) * h)
        at = place
        symbolic.evaluate()
        y[place] = symbolic.block.y.copy()
    x.move(column, -at * h)
    return np.asarray(-(8 * (y[1] - y[-1]) - (y[2] - y[-2])) / (12 * h))


@pytest.fixture
def symbolic_check(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (test_blocks, test_sensors, test_intersystem, test_link_atmosphere):
        monkeypatch.setattr(module, "assert_jacobians", check)


CASES: list[tuple[Any, ...]] = [
    (test_blocks.test_differences_of_code_phase_and_doppler, ("imu", "imu"), 0.4),
    (test_blocks.test_differences_of_code_phase_and_doppler, ("motion", "imu"), 0.0),
    (test_blocks.test_differences_of_code_phase_and_doppler, ("fixed", "motion"), 0.4),
    (test_blocks.test_undifferenced_code_and_doppler, "imu", 0.4),
    (test_blocks.test_undifferenced_code_and_doppler, "motion", 0.0),
    (test_blocks.test_positions_and_heights, "imu", 0.4),
    (test_blocks.test_positions_and_heights, "motion", 0.0),
    (test_blocks.test_ranges_with_bias_and_scale, ("imu", "imu"), False),
    (test_blocks.test_ranges_with_bias_and_scale, ("motion", "imu"), True),
    (test_blocks.test_ranges_with_bias_and_scale, ("fixed", "motion"), False),
    (test_blocks.test_levers_and_time_offsets_of_differences, 0.4),
    (test_blocks.test_levers_and_time_offsets_of_positions_and_heights, 0.0),
    (test_blocks.test_levers_and_one_time_offset_of_ranges,),
    (test_intersystem.test_jacobians_of_biases,),
    (test_link_atmosphere.test_jacobians_of_delays_and_their_processes,),
    (test_sensors.test_odometer, "at states", False),
    (test_sensors.test_odometer, "between", True),
    (test_sensors.test_attitude, "at states", 0.0),
    (test_sensors.test_attitude, "between", 0.3),
    (test_sensors.test_magnetometer, "between"),
    (test_sensors.test_vision, "at states", "vehicle without"),
    (test_sensors.test_vision, "between", "vehicle with IMU"),
    (test_sensors.test_vision, "between", "landmark"),
    (test_sensors.test_velocities_of_fixes, "imu", 0.4),
    (test_sensors.test_velocities_of_fixes, "motion", 0.0),
    (test_sensors.test_time_offsets_turn_and_move,),
    (test_sensors.test_imu_time_offset_reaches_the_attitude,),
    (test_sensors.test_barometer, "imu"),
    (test_sensors.test_barometer, "motion"),
    (test_sensors.test_non_holonomic_rows,),
    (test_sensors.test_height_hold, "imu"),
    (test_sensors.test_rest_by_the_odometer,),
]


def _name(case: tuple[Any, ...]) -> str:
    return " ".join([case[0].__name__.removeprefix("test_"), *map(str, case[1:])])


@pytest.mark.usefixtures("symbolic_check")
@pytest.mark.parametrize("case", CASES, ids=_name)
def test_blocks_by_their_models(case: tuple[Any, ...]) -> None:
    run, *arguments = case
    run(*arguments)


def test_points_a_little_before_their_state() -> None:
    """Up to 5 ms before a state its own increments are none; velocity and rate carry the point back."""
    _, ends = test_blocks.problem_of(("imu", "imu"))
    parameters = Parameters()
    (block,) = range_blocks(test_blocks.ranges_between(np.array([0.997, 1.4, 2.996, 3.0]), False), ends, parameters)
    assert isinstance(block, RangeBlock) and block.a.query.dt_s.min() < -2e-3 and block.a.query.increments is not None
    # by hand the gyroscope's bias does not turn the few milliseconds back
    check(test_blocks.evaluated(ends, [block], parameters), block, test_blocks.STEP, 1e-2)


def test_two_antennas_of_one_body() -> None:
    """Both ends have the same columns."""
    problem, ends = test_blocks.problem_of(("imu", "imu"), 0.4)
    link = test_blocks.link_of(problem, ends).block
    behind = replace(link.rover.query, lever_b=link.rover.query.lever_b + [0.1, -1.5, 0.2])
    block = replace(link, reference=Endpoint(link.rover.vehicle, behind))
    assert block.columns_of.shared and sum(block.columns_of.dims) == 15
    check(test_blocks.evaluated(ends, [block]), block, test_blocks.GNSS_STEP, test_blocks.CARRIED)


@pytest.mark.parametrize("far", [0.0, 1e-3, 0.3])
@pytest.mark.parametrize(
    "calibration", [ImuCalibration(), ImuCalibration(gyro_scale=0.01, accel_scale=0.01), ImuCalibration(gyro_scale=0.01)]
)
def test_inertial_intervals(far: float, calibration: ImuCalibration) -> None:
    v = test_inertial_block.rough_vehicle(2, far, calibration)
    parameters = Parameters()
    block = imu_block(v, parameters)
    assert block is not None
    v.bias += np.random.default_rng(1).normal(0, 0.01, v.bias.shape)
    for p in parameters:
        p.value = np.random.default_rng(2).normal(0, 1e-3, 3)
    block.intervals = replace(block.intervals, whitening=_balanced(block.intervals.whitening))
    check(Graph([v], GtsamEngine(), [block], parameters=parameters), block, IMU_STEP, EXACT)


@pytest.mark.parametrize("far", [0.0, 0.5])
def test_first_states(far: float) -> None:
    """Of a vehicle with IMU, near its alignment and half a radian off; of one without, linear."""
    _, ends = test_blocks.problem_of(("imu", "motion"))
    a = ends["a"]
    a.attitude_prior = (a.R[0] @ attitude.exp_so3(far * np.array([0.6, -0.5, 0.6])), np.array([0.1, 0.1, 0.3]))
    block, linear = state_prior(a), state_prior(ends["b"])
    assert block is not None and linear is not None
    a.r, a.v = a.r + 1.0, a.v - 2.0
    check(Graph([a], GtsamEngine(), [block]), block, IMU_STEP, EXACT)
    evaluate(linear)
    assert np.array_equal(linear.J, np.eye(6))


def _balanced(whitening: Array) -> Array:
    """Rows of unit size: positions weigh a million times what rotations do, and hide their errors."""
    return np.asarray(whitening / np.linalg.norm(whitening, axis=2, keepdims=True))


def test_every_kind_of_block_is_known() -> None:
    """Whoever adds a block adds its model."""

    def below(kind: Any) -> set[Any]:
        found = set(kind.__subclasses__())
        return found.union(*(below(k) for k in found))

    ours = {k.__name__ for k in below(Block) if not k.__abstractmethods__ and k.__module__.startswith("factorgraph.assembly.")}
    known: tuple[Any, ...] = (*RECIPES, *LINEAR, GnssBlock, ImuBlock, ZeroRotationBlock, StatePrior)
    assert ours == {k.__name__ for k in known}


def test_a_block_without_a_model_is_refused() -> None:
    class Unknown(PositionBlock):
        pass

    _, ends = test_blocks.problem_of(("fixed", "motion"))
    position, _ = position_blocks(ends["b"], Parameters())
    assert isinstance(position, PositionBlock)
    unknown = Unknown(position.rows, end=position.end, z_n=position.z_n)
    with pytest.raises(TypeError, match="Unknown has no symbolic model"):
        evaluate(unknown)


def test_an_evaluator_follows_its_block() -> None:
    """Points that move to other states with a time offset, biases preintegrated at anew, scale factors taken out."""
    _, ends, parameters = test_blocks.calibrated_problem(0.1)
    position, _ = position_blocks(ends["b"], parameters)
    assert isinstance(position, PositionBlock)
    symbolic = evaluator(position)
    symbolic.evaluate()
    before = position.end.query.k.copy()
    parameters.of_name["b/position time offset"].value[:] = 0.3
    ends["b"].preintegrated_bias = ends["b"].bias + 1e-3
    position.refresh()
    assert np.any(position.end.query.k != before)
    ends["b"].r += 1.0
    symbolic.evaluate()
    y = position.y.copy()
    position.predict()
    np.testing.assert_allclose(y, position.y, rtol=1e-12, atol=1e-11)


def test_an_inertial_evaluator_follows_its_block() -> None:
    v = test_inertial_block.rough_vehicle(1, 0.1)
    block = test_inertial_block.block_of(v)
    symbolic = evaluator(block)
    symbolic.evaluate()
    before = block.y.copy()
    v.preintegrated_bias = v.preintegrated_bias + 0.01
    block.refresh()
    symbolic.evaluate()
    y = block.y.copy()
    block.predict()
    np.testing.assert_allclose(y, block.y, rtol=1e-9, atol=1e-6)
    assert np.abs(y - before).max() > 0.1


# -- rotations and gravity --------------------------------------------------------------------------


def test_rotations_are_those_of_attitude() -> None:
    """Through every branch: no angle, tiny ones, those where series meet closed forms, nearly half a turn about each axis."""
    rng = np.random.default_rng(0)
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(0, 1, (10, 3))])
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    edge = np.sqrt(rotations.SMALL)
    angles = np.array([0.0, 1e-9, 1e-4, 0.99 * edge, 1.01 * edge, 0.5, 2.0, 3.0, np.pi - 1e-3])
    phi = (axes[:, None, :] * angles[:, None]).reshape(-1, 3)

    def model(s: Symbols) -> dict[str, ca.SX]:
        x, C = s.vector("phi", 3), matrix(s.vector("C", 9), 3, 3)
        turn, one = rotations.Turn.by(x), ca.SX([0, 0, 1])
        across = {"apply": turn.apply(one), "back": turn.back(one)}
        left = rotations.left_jacobian_inverse(x)
        return {"exp": flat(rotations.exp_so3(x)), "log": rotations.log_so3(C), "left": flat(left), **across}

    C = attitude.exp_so3(phi)
    samples = Samples(linearised(model), len(phi))
    samples.set({"phi": phi, "C": C.reshape(-1, 9)})
    out = samples.run()
    np.testing.assert_allclose(out["exp"].reshape(-1, 3, 3), C, atol=1e-12)  # attitude's own series end at 1e-4 rad
    np.testing.assert_allclose(out["log"], phi, atol=1e-12)
    left = attitude.right_jacobian_inverse(-phi)
    np.testing.assert_allclose(out["left"].reshape(-1, 3, 3), left, atol=1e-9)
    np.testing.assert_allclose(out["apply"], C[:, :, 2], atol=1e-12)
    np.testing.assert_allclose(out["back"], C[:, 2], atol=1e-12)


def test_small_rotations_are_exact_up_to_a_tenth() -> None:
    phi = 0.1 * np.array([[0.6, 0.0, -0.8], [0.0, 0.0, 0.0], [1e-3, 0.0, 0.0]])

    def model(s: Symbols) -> dict[str, ca.SX]:
        return {"C": flat(rotations.exp_small(s.vector("phi", 3)))}

    samples = Samples(linearised(model), 3)
    samples.set({"phi": phi})
    np.testing.assert_allclose(samples.run()["C"].reshape(-1, 3, 3), attitude.exp_so3(phi), atol=2e-13)


def test_gravity_is_geodesys_and_grows_downwards() -> None:
    """2 g / R is 3.1e-6 per second squared; also far from the origin of the frame."""
    frame = FRAME
    r = np.array([[0.0, 0.0, 0.0], [4e4, -7e4, 2e3]])
    samples = Samples(linearised(point.gravity), 2)
    samples.set({"r": r, "centre": frame.rotate_from_ecef(frame.origin_ecef), "w_ie": frame.w_ie_n})
    out = samples.run()
    np.testing.assert_allclose(out["g"], frame.gravity(r), rtol=1e-12, atol=1e-12)
    assert out["g_r"].reshape(-1, 3, 3)[0, 2, 2] == pytest.approx(3.08e-6, rel=0.01)


# -- functions --------------------------------------------------------------------------------------


def test_functions_are_built_once_with_names() -> None:
    near = point.EndShape("near")
    f = linearised(ranging.point_range, near, None, True, False)
    assert f is linearised(ranging.point_range, point.EndShape("near"), None, True, False)
    assert f.name_in() == ["a_state", "a_sample", "a_earth", "anchor", "bias", "z"]
    assert f.name_out() == ["e", "e_a", "e_bias"]


def test_samples_want_every_input() -> None:
    samples = Samples(linearised(motion.zero_rotation), 2)
    samples.set({"dt": np.ones(2), "before": np.eye(3).ravel(), "of another model": np.ones(7)})
    with pytest.raises(KeyError, match="has no after"):
        samples.run()
    samples.set({"after": np.eye(3).ravel()})
    first, second = samples.run()["e"], samples.run()["e"]
    assert not np.shares_memory(first, second) and not np.any(first)


@pytest.fixture
def some_range() -> tuple[ca.Function, dict[str, Array]]:
    f = linearised(ranging.point_range, point.EndShape("carried"), point.EndShape("motion"), True, True)
    rng = np.random.default_rng(0)
    return f, {str(name): rng.normal(0, 1, (40, f.numel_in(name))) for name in f.name_in()}


def run(f: ca.Function, inputs: dict[str, Array]) -> dict[str, Array]:
    samples = Samples(f, 40)
    samples.set(inputs)
    return samples.run()


@pytest.mark.skipif(not any(map(shutil.which, functions.COMPILERS)), reason="no C compiler")
def test_compiled_functions_are_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, some_range: tuple[ca.Function, dict[str, Array]]
) -> None:
    """To the last digits; kept where the environment says, compiled once and never written again."""
    f, inputs = some_range
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("sys.platform", "linux")
    g = compiled(f)
    assert g.class_name() == "External"
    (library,) = functions.cache_directory().iterdir()
    assert library.is_relative_to(tmp_path) and library.suffix == ".so"
    written = library.stat().st_mtime_ns
    a, b = run(f, inputs), run(g, inputs)
    assert list(a) == list(b)
    for name in a:
        np.testing.assert_allclose(b[name], a[name], rtol=1e-14, atol=1e-14 * np.abs(a[name]).max())
    again = compiled(f)
    assert again.class_name() == "External" and library.stat().st_mtime_ns == written
    assert [library] == list(functions.cache_directory().iterdir())


@pytest.mark.parametrize("why", ["no compiler", "compiler fails", "cache is no directory"])
def test_without_compiled_functions_the_virtual_machine_does(
    why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, some_range: tuple[ca.Function, dict[str, Array]]
) -> None:
    found = {"no compiler": None, "compiler fails": "/bin/false", "cache is no directory": "/bin/true"}[why]
    monkeypatch.setattr("shutil.which", lambda _: found)
    place = tmp_path / "cache"
    if why == "cache is no directory":
        place.write_text("")
    f, _ = some_range
    assert compiled(f, place) is f


def test_the_environment_asks_for_compiled_functions(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[ca.Function] = []

    def kept(f: ca.Function) -> ca.Function:
        asked.append(f)
        return f

    monkeypatch.setattr(functions, "compiled", kept)
    v = test_inertial_block.rough_vehicle(0, 0.0)
    for value, expected in (("", 0), ("1", 1)):
        monkeypatch.setenv(functions.CODEGEN_VARIABLE, value)
        linearised.cache_clear()
        evaluate(test_inertial_block.block_of(v))
        assert len(asked) == expected
    linearised.cache_clear()


def test_linear_blocks_predict_themselves() -> None:
    _, ends = test_blocks.problem_of(("fixed", "motion"))
    block = motion_block(ends["b"])
    block.predict()
    y, J = block.y, block.J
    ends["b"].r[1] += 1.0
    evaluate(block)
    assert np.any(block.y != y) and np.array_equal(block.J, J)
