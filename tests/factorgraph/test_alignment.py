"""Start attitudes: what motion, rest, directions and declarations tell, how well, and what happens where nothing tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.alignment import Alignment, Directions, align, course
from factorgraph.assembly.attitudes import between_fixes, directions_of
from factorgraph.attitude import euler_from_matrix, exp_so3, log_so3, matrix_from_euler, quat_from_matrix
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import AttitudeStream, Calibration, ImuStream, MagneticStream, PositionStream
from factorgraph.models.strapdown import ideal_imu
from factorgraph.problem import ImuNoise, Vehicle
from factorgraph.types import Array

FRAME = LocalFrame(np.deg2rad(50.0), np.deg2rad(8.0), 300.0)
NOISE = ImuNoise(1.4e-4, 1.2e-3, 5e-3, 0.1, 1e-5, 1e-4)  # a good MEMS unit
RATE_HZ = 100.0
Path = tuple[Array, Array, Array]  # r_n, v_n, C_nb


def turning(t: Array, heading: float) -> Path:
    """A circle, banked, nose along the track."""
    speed, rate = 20.0, 0.1
    psi = heading + rate * t
    v = speed * np.column_stack([np.sin(psi), np.cos(psi), np.zeros_like(t)])
    r = speed / rate * np.column_stack([-np.cos(psi), np.sin(psi), np.zeros_like(t)])
    return r, v, matrix_from_euler(np.zeros_like(t), np.full_like(t, np.arctan(speed * rate / 9.81)), psi)


def resting(t: Array, heading: float) -> Path:
    still = np.zeros((len(t), 3))
    return still, still, np.tile(matrix_from_euler(0.05, -0.03, heading), (len(t), 1, 1))


def straight(t: Array, heading: float) -> Path:
    """Ahead at constant speed."""
    v = np.tile([15 * np.sin(heading), 15 * np.cos(heading), 0.0], (len(t), 1))
    return v * t[:, None], v, np.tile(matrix_from_euler(0.0, 0.0, heading), (len(t), 1, 1))


def swaying(t: Array, heading: float, size_m: float = 1.0) -> Path:
    """About a place, pointing elsewhere than it moves."""
    w = np.array([0.53, 0.41, 0.3])
    phase = np.array([0.3, 1.9, 4.0]) + heading
    r = size_m * np.sin(w * t[:, None] + phase)
    v = size_m * w * np.cos(w * t[:, None] + phase)
    tilt = 0.03 * np.sin(0.7 * t + heading)
    return r, v, matrix_from_euler(tilt, -0.5 * tilt, heading + 0.2 * np.sin(0.2 * t))


def leaving(t: Array, heading: float) -> Path:
    """Twenty seconds at rest, then straight ahead."""
    since = np.maximum(t - 20.0, 0.0)[:, None]
    ahead = np.array([np.sin(heading), np.cos(heading), 0.0])
    return since**2 * ahead, 2 * since * ahead, np.tile(matrix_from_euler(0.02, -0.03, heading), (len(t), 1, 1))


class Trial:
    """A motion measured, aligned, and what is wrong with the attitudes."""

    def __init__(
        self,
        path: object,
        heading: float = 2.0,
        *,
        duration_s: float = 30.0,
        sigma_mps: float = 0.0,
        bias: Array | float = 0.0,
        noisy: bool = False,
        seed: int = 0,
        mounting: Array | None = None,
        drop: tuple[float, float] | None = None,
    ) -> None:
        rng = np.random.default_rng(seed)
        grid, t = np.arange(duration_s + 1), np.arange(-1, duration_s * RATE_HZ + 1) / RATE_HZ
        f, w = (x[1:] for x in ideal_imu(FRAME, t, *path(t, heading)))  # type: ignore[operator]
        t = t[1:]
        if noisy:
            f = f + rng.normal(0.0, NOISE.accel_mps2_rthz * np.sqrt(RATE_HZ), f.shape) + rng.normal(0.0, 0.1, 3)
            w = w + rng.normal(0.0, NOISE.gyro_rps_rthz * np.sqrt(RATE_HZ), w.shape) + rng.normal(0.0, 5e-3, 3)
        C_bs = np.eye(3) if mounting is None else mounting
        keep = np.ones(len(t), bool) if drop is None else (t < drop[0]) | (t > drop[1])
        self.imu = ImuStream(t[keep], (f @ C_bs)[keep], (w @ C_bs)[keep] + bias, True)
        self.grid, (self.r, v, C) = grid, path(grid, heading)  # type: ignore[operator]
        self.v, self.true = v + rng.normal(0.0, sigma_mps, v.shape), C @ C_bs

    def align(
        self, heading: tuple[float, float] | None = None, directions: tuple[Directions, ...] = (), noise: ImuNoise = NOISE
    ) -> Alignment:
        return align(self.imu, self.grid, self.r, self.v, FRAME, noise, heading, directions)

    def error(self, found: Alignment) -> Array:
        """Rotation errors (K, 3) about east, north, up."""
        return log_so3(found.C_nb @ np.swapaxes(self.true, 1, 2))


# -- motion ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sigma_mps", "bound_rad"), [(0.0, 0.01), (0.1, 0.06), (0.3, 0.15)])
@pytest.mark.parametrize("heading", [-2.5, 0.1, 2.0])
def test_a_turning_vehicle_is_aligned(heading: float, sigma_mps: float, bound_rad: float) -> None:
    trial = Trial(turning, heading, sigma_mps=sigma_mps)
    found = trial.align()
    assert found.way == "motion" and found.is_decided
    assert np.linalg.norm(trial.error(found), axis=1).max() < bound_rad


def test_motion_that_is_not_along_the_nose_tells_the_heading_too() -> None:
    for heading in np.linspace(-3.0, 3.0, 4):
        trial = Trial(swaying, float(heading), duration_s=60.0, sigma_mps=0.05, noisy=True, seed=3)
        found = trial.align()
        assert found.way == "motion"
        assert np.abs(trial.error(found)[:, 2]).max() < 0.2


def test_attitude_of_an_imu_mounted_in_an_unknown_way() -> None:
    """Axes turned by up to 180 degrees about any direction: nothing assumes that up is up."""
    rng = np.random.default_rng(5)
    for seed in range(6):
        axis = rng.normal(size=3)
        mounting = exp_so3(rng.uniform(0, np.pi) * axis / np.linalg.norm(axis))
        if seed == 0:
            mounting = exp_so3(np.array([np.pi, 0.0, 0.0]))  # upside down
        heading = float(rng.uniform(-3, 3))
        trial = Trial(swaying, heading, duration_s=60.0, sigma_mps=0.05, noisy=True, seed=seed, mounting=mounting)
        found = trial.align()
        assert found.way == "motion"
        assert np.linalg.norm(trial.error(found), axis=1).max() < 0.2, seed


def test_the_heading_is_as_good_as_it_says() -> None:
    errors = []
    for seed in range(16):
        trial = Trial(swaying, 0.15 * seed, duration_s=60.0, sigma_mps=0.1, noisy=True, seed=seed)
        found = trial.align()
        errors.append(trial.error(found)[0] / found.sigma_rad)
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all(rms < 1.5) and rms[2] > 0.4


def test_biases_drift_over_a_long_flight() -> None:
    trial = Trial(swaying, duration_s=400.0, sigma_mps=0.05)
    drift = np.linspace(0.0, 4e-3, len(trial.imu.t_s))[:, None] * [1.0, -1.0, 0.5]
    trial.imu = replace(trial.imu, w_b=trial.imu.w_b + drift)
    found = trial.align()
    assert np.linalg.norm(trial.error(found), axis=1).max() < 0.06
    at = np.searchsorted(trial.imu.t_s, trial.grid).clip(0, len(drift) - 1)
    assert np.abs(found.bias[:, :3] - drift[at]).max() < 2e-3


def test_heading_from_motion_goes_back_to_the_rest_before() -> None:
    """The gyroscope knows that the vehicle stood as it left."""
    trial = Trial(leaving, duration_s=40.0)
    found = trial.align()
    assert found.way == "motion"
    assert np.linalg.norm(trial.error(found), axis=1).max() < 0.05


def test_a_gap_in_the_imu_does_not_lose_the_heading() -> None:
    """What comes after it has nothing but straight flight to tell."""

    def then_straight(t: Array, heading: float) -> Path:
        r, v, C = turning(np.minimum(t, 60.0), heading)
        return r + v * np.maximum(t - 60.0, 0.0)[:, None], v, C

    trial = Trial(then_straight, duration_s=120.0, sigma_mps=0.05, drop=(60.2, 60.8))
    error = trial.error(trial.align())
    assert np.abs(error[:, 2]).max() < 0.5


# -- rest and declarations -------------------------------------------------------------------------


def test_rest_tells_level_and_rate_bias_but_no_heading() -> None:
    trial = Trial(resting, bias=0.01, sigma_mps=0.02)
    found = trial.align()
    assert found.way == "levelling" and not found.is_decided
    error = trial.error(found)
    assert np.abs(error[:, :2]).max() < 0.01 and np.ptp(error[:, 2]) < 0.02  # heading unknown but steady
    np.testing.assert_allclose(found.bias[:, :3], 0.01, atol=2e-4)  # the Earth's rate is taken for bias: 7e-5
    _, sigma = found.prior
    assert sigma[2] == 3.0 and np.all(sigma[:2] < 0.5)


def test_noise_is_not_taken_for_motion() -> None:
    """Integrated noise of the IMU looks like motion, and an error of the velocities like an answer to it."""
    for seed in range(10):
        assert not Trial(resting, duration_s=60.0, sigma_mps=0.05, noisy=True, seed=seed).align().is_decided


def test_a_vehicle_at_rest_takes_the_declared_heading() -> None:
    trial = Trial(resting, sigma_mps=0.02, noisy=True)
    found = trial.align(heading=(2.1, 0.2))
    assert found.way == "declared"
    C_nb, sigma = found.prior
    assert float(euler_from_matrix(C_nb)[2]) == pytest.approx(2.1, abs=1e-6) and sigma[2] == 0.2
    assert np.abs(trial.error(found)[:, 2]).max() < 0.25


def test_motion_refutes_a_wrong_declaration() -> None:
    trial = Trial(swaying, duration_s=60.0, sigma_mps=0.05, noisy=True)
    found = trial.align(heading=(-1.0, 0.3))
    assert found.way == "motion" and found.declared is None
    assert np.abs(trial.error(found)[:, 2]).max() < 0.2
    agreed = trial.align(heading=(2.1, 0.3))
    assert agreed.declared == (2.1, 0.3) and np.abs(trial.error(agreed)[:, 2]).max() < 0.2


def test_priors_do_not_count_the_data_twice() -> None:
    """What the graph sees as measurements comes as a prior of 1 % of the information."""
    found = Trial(swaying, duration_s=60.0, sigma_mps=0.05, noisy=True).align()
    C_nb, sigma = found.prior
    np.testing.assert_array_equal(C_nb, found.C_nb[0])
    np.testing.assert_allclose(sigma, np.minimum(10 * found.sigma_rad, [1.0, 1.0, 3.0]))


# -- directions ------------------------------------------------------------------------------------


def test_course_is_the_heading_only_of_what_moves_forward() -> None:
    trial = Trial(straight, sigma_mps=0.05, noisy=True)
    assert not trial.align().is_decided
    found = trial.align(directions=(course(trial.grid, trial.v, 0.1),))
    assert found.way == "course"
    assert np.abs(trial.error(found)[:, 2]).max() < 0.1 and found.sigma_rad[2] < 0.2


def vehicle(trial: Trial, **sensors: object) -> Vehicle:
    return Vehicle("a", imu=trial.imu, **sensors)  # type: ignore[arg-type]


def test_an_attitude_system_and_a_magnetometer_tell_the_heading_at_rest() -> None:
    trial = Trial(resting, duration_s=30.0, sigma_mps=0.02, noisy=True)
    n = len(trial.grid)
    full = AttitudeStream(trial.grid, quat_from_matrix(trial.true), np.full((n, 3), 0.03))
    heading = replace(full, sigma_rad=np.tile([np.inf, np.inf, 0.03], (n, 1)))
    level = replace(full, sigma_rad=np.tile([0.03, 0.03, np.inf], (n, 1)))
    field = np.array([0.0, 20.0, -43.0])
    m_b = np.einsum("nji,j->ni", trial.true, field)
    magnetic = MagneticStream(trial.grid, m_b, np.full((n, 3), 1.0), (0.0, 20.0, -43.0), calibration=Calibration(bias=2.0))
    for sensors, way in (
        ({"attitudes": (full,)}, "attitude sensor"),
        ({"attitudes": (heading,)}, "attitude sensor"),
        ({"magnetics": (magnetic,)}, "magnetometer"),
    ):
        found = trial.align(directions=directions_of(vehicle(trial, **sensors)))
        assert found.way == way
        assert np.abs(trial.error(found)[:, 2]).max() < 0.1, way
    assert directions_of(vehicle(trial, attitudes=(level,))) == ()


def fixes(trial: Trial, lever: tuple[float, float, float], sigma_m: float, delay_s: float = 0.0) -> PositionStream:
    t = trial.grid + delay_s
    r = trial.r + trial.true @ np.array(lever)
    return PositionStream(t, r, np.full((len(t), 3), sigma_m), lever)


def test_fixes_of_two_antennas_tell_the_heading_at_rest() -> None:
    trial = Trial(resting, sigma_mps=0.02, noisy=True)
    a, b = fixes(trial, (0.0, 0.5, 0.3), 0.01), fixes(trial, (0.0, -0.5, 0.3), 0.01, 0.015)
    line = between_fixes(a, b)
    assert line is not None and len(line.t_s) == len(trial.grid)
    found = trial.align(directions=(line,))
    assert found.way == "antennas" and np.abs(trial.error(found)[:, 2]).max() < 0.05
    assert between_fixes(a, replace(b, sigma_m=np.full_like(b.sigma_m, 3.0))) is None  # code tells no metre
    assert between_fixes(a, replace(b, lever_b=a.lever_b)) is None
    late = fixes(trial, (0.0, -0.5, 0.3), 0.01, 0.4)
    assert between_fixes(a, late) is None  # a second apart, and neither at a time of the other
    far = replace(b, r_n=b.r_n + 5.0)
    assert between_fixes(a, far) is None  # not where the lever arms put it


def test_the_way_is_the_one_that_told() -> None:
    """Motion that tells the heading by itself is named, although a magnetometer agrees."""
    trial = Trial(turning, duration_s=60.0, sigma_mps=0.03)
    n = len(trial.grid)
    rough = AttitudeStream(trial.grid, quat_from_matrix(trial.true), np.full((n, 3), 0.4))
    found = trial.align(directions=directions_of(vehicle(trial, attitudes=(rough,))))
    assert found.way == "motion"


def test_without_a_gyroscope_attitudes_are_those_of_each_moment() -> None:
    trial = Trial(turning, duration_s=60.0)
    line = Directions("antennas", trial.grid, np.tile([0.0, 1.0, 0.0], (61, 1)), trial.true[:, :, 1], np.full(61, 0.01))
    found = trial.align(directions=(line,), noise=replace(NOISE, gyro_rps_rthz=0.5))
    heading = euler_from_matrix(found.C_nb)[2] - euler_from_matrix(trial.true)[2]
    assert np.abs(np.mod(heading + np.pi, 2 * np.pi) - np.pi).max() < 0.02
    assert not trial.align(noise=replace(NOISE, gyro_rps_rthz=0.5)).is_decided
