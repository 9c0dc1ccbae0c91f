"""The local filter of 20 states: signs, radii of curvature, clock, start, and consistency on the flight of `ahrs-tdo`."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from factorgraph import geodesy
from factorgraph.attitude import exp_so3, log_so3, matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.filters import tightly_coupled
from factorgraph.filters.inertial import ATT, VEL, ImuModel, InertialStart, Navigator
from factorgraph.filters.tightly_coupled import TightSettings, TightTrack, point_start
from factorgraph.geodesy import C_MPS, LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models.receivers import receivers
from factorgraph.models.strapdown import ideal_imu
from factorgraph.types import Array
from scenarios.published import ahrs_tdo
from scenarios.published.ahrs_tdo import FOLLOWER, LEADER, AhrsTdoFlight
from scenarios.simulate.flight import Exact, exact, simulate
from scenarios.simulate.scenario import Scenario
from scenarios.simulate.trajectory import _radii
from tests.helpers import assert_consistent

SHORT_S = 40.0
PERFECT = ImuModel(0.0, 0.0, 0.0, 0.0, 3600.0, 0.0, 3600.0)


def short() -> Scenario:
    scenario = ahrs_tdo.scenario()
    return scenario.model_copy(update={"scenario": scenario.scenario.model_copy(update={"duration_s": SHORT_S})})


@cache
def known() -> Exact:
    return exact(short(), 0)


def flown(seed: int) -> AhrsTdoFlight:
    simulated = simulate(short(), seed, known())
    return AhrsTdoFlight(simulated, ahrs_tdo.without_phases(simulated.problem), "0.01g")


def errors(flight: AhrsTdoFlight, name: str, track: TightTrack) -> tuple[Array, Array]:
    """Errors (K, 17) and covariance (K, 17, 17); constant and varying part of the gyro bias count together."""
    truth, imu = flight.record.trajectories[name].at(track.t_s), flight.record.imu[name]
    samples = flight.problem.vehicle(name).imu
    assert samples is not None
    k = np.clip(np.searchsorted(samples.t_s, track.t_s - 1e-4), 0, len(samples.t_s) - 1)
    gnss = flight.record.gnss[name]
    gyro = imu.gyro_bias_rps[k] - track.sensors[:, :3] - track.sensors[:, 3:6]
    clock = C_MPS * np.column_stack([gnss.clock_s, gnss.clock_drift]) - track.clock
    phi = -log_so3(track.C_nb @ np.swapaxes(truth.C_nb, 1, 2))
    moved = [track.r_n - truth.r_n, track.v_n - truth.v_n, phi, gyro, imu.accel_bias_mps2[k] - track.sensors[:, 6:], clock]
    T = np.zeros((17, 20))
    T[:9, :9], T[9:12, 9:12], T[9:12, 12:15], T[12:, 15:] = np.eye(9), np.eye(3), np.eye(3), np.eye(5)
    return np.hstack(moved), T @ track.P_all @ T.T


def test_a_level_error_accelerates_as_f_cross_phi() -> None:
    """Spec ahrs_tdo.md, check 4 and erratum E8: 1 mrad about east at rest gives g 1e-3 to the north, in filter and navigator."""
    frame, phi = LocalFrame(np.deg2rad(32.0), np.deg2rad(118.8), 0.0), np.array([1e-3, 0.0, 0.0])
    t, still = np.arange(-1, 101) / 100, np.zeros((102, 3))
    f, w = ideal_imu(frame, t, still, still, np.tile(np.eye(3), (102, 1, 1)))
    start = InertialStart(np.zeros(3), np.zeros(3), exp_so3(-phi), np.zeros((9, 9)))
    nav = Navigator(ImuStream(t[1:], f[1:], w[1:], is_mean=True), frame, start, PERFECT, 0.0)
    f_n, middle = nav.advance(1.0)
    expected = np.cross(f[-1], phi)
    assert expected[1] == pytest.approx(9.8e-3, rel=1e-2)
    np.testing.assert_allclose(nav.v, expected, atol=1e-5)
    Phi, _ = nav.transition(f_n, middle, np.zeros(18), 1.0)
    np.testing.assert_allclose(Phi[VEL, ATT] @ phi, expected, atol=1e-5)


def test_first_order_radii_are_right_only_with_the_sine_squared() -> None:
    """Spec ahrs_tdo.md, check 5 and erratum E10, at 30 to 45 deg."""
    L = np.deg2rad(np.linspace(30.0, 45.0, 16))
    exact_M, exact_N = _radii(L)
    for s, limits in ((np.sin(L) ** 2, (0.0, 75.0)), (np.sin(2 * L), (10e3, 41e3))):
        M, N = geodesy.A_M * (1 - 2 * geodesy.F + 3 * geodesy.F * s), geodesy.A_M * (1 + geodesy.F * s)
        off = np.concatenate([np.abs(M - exact_M), np.abs(N - exact_N)])
        assert limits[0] <= off.min() and off.max() < limits[1]


def test_ten_minutes_with_code_alone_stay_below_three_metres() -> None:
    """Spec ahrs_tdo.md, check 7: 600 s, 3 m pseudoranges, started without any truth."""
    flight = ahrs_tdo.simulate_flight(11)
    for name, track in ahrs_tdo.local_filters(flight).items():
        off = track.r_n - flight.record.trajectories[name].at(track.t_s).r_n
        rms = np.sqrt(np.mean(np.sum(off**2, axis=1)))
        assert 0.5 < rms < 3.0
        assert np.all(track.n_rows == 8) and 0.9 < np.mean(track.nis / track.n_rows) < 1.1


@pytest.mark.parametrize("use_doppler", [False, True])
def test_errors_are_as_large_as_told(use_doppler: bool) -> None:
    """NEES of all states after 10 and 40 s over 24 vehicles, two-sided."""
    found = []
    for seed in range(12):
        flight = flown(seed)
        tracks = ahrs_tdo.local_filters(flight, ahrs_tdo.local_settings(use_doppler))
        found += [errors(flight, name, track) for name, track in tracks.items()]
    for k in (10, 40):
        assert_consistent(np.array([e[k] for e, _ in found]), np.array([P[k] for _, P in found]))


def test_weights_are_flat_or_grow_towards_the_horizon() -> None:
    low = np.deg2rad([90.0, 30.0])
    flat, sine = TightSettings(3.0, 0.03, elevation="flat"), TightSettings(3.0, 0.03)
    np.testing.assert_allclose(flat.sigmas(low), ([3.0, 3.0], [0.03, 0.03]))
    np.testing.assert_allclose(sine.sigmas(low), np.outer([3.0, 0.03], np.sqrt([2.0, 5.0])))


def test_a_drift_that_returns_is_integrated() -> None:
    """Closed form against many short steps; without return the drift stays."""
    assert tightly_coupled._drift_over(2.0, 0.0) == (2.0, 1.0)
    offset, drift = 0.0, 1.0
    for _ in range(20_000):
        offset, drift = offset + 1e-3 * drift, drift * (1 - 1e-3 * 0.1)
    np.testing.assert_allclose(tightly_coupled._drift_over(20.0, 0.1), (offset, drift), rtol=2e-4)
    with pytest.raises(InputError, match="drift_beta_hz must not be negative"):
        TightSettings(drift_beta_hz=-1.0)


def test_codes_without_doppler_are_used_where_no_doppler_is_wanted() -> None:
    flight = flown(3)
    vehicle = flight.problem.vehicle(FOLLOWER)
    assert vehicle.gnss is not None
    ready = receivers(flight.problem)[FOLLOWER]
    mute = replace(ready, prepared=replace(ready.prepared, rate_mps=np.full_like(ready.prepared.rate_mps, np.nan)))
    start = point_start(ready, flight.problem.frame, matrix_from_quat(flight.ahrs(FOLLOWER).q_nb[0]), 1e-5 * np.eye(3))
    model = ahrs_tdo.imu_model()
    for use, rows in ((False, 8), (True, 0)):
        track = tightly_coupled.run(mute, flight.problem.frame, start, model, ahrs_tdo.local_settings(use))
        assert np.all(track.n_rows == rows)


def test_the_start_is_at_the_first_epoch_and_at_the_body() -> None:
    """Two lost epochs and a lever arm; no truth is used."""
    flight = flown(4)
    ready, frame = receivers(flight.problem)[LEADER], flight.problem.frame
    C_nb, arm = matrix_from_quat(flight.ahrs(LEADER).q_nb[0]), (0.0, 3.0, 0.0)
    point = replace(ready.point, r_ecef=ready.point.r_ecef.copy())
    point.r_ecef[:2] = np.nan
    antenna = replace(ready.antenna, lever_b=arm)
    moved = replace(ready, vehicle=replace(ready.vehicle, gnss=antenna), point=point)
    plain, late = (point_start(rx, frame, C_nb, np.eye(3)) for rx in (ready, moved))
    at_two = frame.from_ecef(point.r_ecef[2]) - C_nb @ arm
    v = frame.rotate_from_ecef(point.v_ecef[2])
    np.testing.assert_allclose(late.r_n, at_two - 2.0 * v)
    np.testing.assert_allclose(plain.r_n, frame.from_ecef(ready.point.r_ecef[0]))
    assert plain.P[0, 0] == 100.0**2 and plain.P[3, 3] == 10.0**2 and plain.P[6, 6] == 1.0
    point.r_ecef[:] = np.nan
    with pytest.raises(InputError, match="vehicle leader: no epoch has a position and a velocity"):
        point_start(moved, frame, C_nb, np.eye(3))
