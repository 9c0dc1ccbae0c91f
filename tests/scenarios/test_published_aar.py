"""The published aerial refuelling: geometry, sensors, paired data sets, integers, starts of inertial filters."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from factorgraph import geodesy
from factorgraph.attitude import euler_from_matrix, log_so3, matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.measurements import GnssStream
from factorgraph.models.gnss import prepare
from factorgraph.models.strapdown import propagate
from scenarios.published import aar
from scenarios.simulate.flight import Exact, exact
from scenarios.simulate.scenario import load_scenario
from scenarios.simulate.streams import Streams


@pytest.fixture(scope="module")
def flight() -> aar.AarFlight:
    return aar.simulate_flight(5)


@pytest.fixture(scope="module")
def known() -> Exact:
    return exact(aar.scenario(), 0)


def stream_of(flight: aar.AarFlight, name: str) -> GnssStream:
    antenna = flight.problem.vehicle(name).gnss
    assert antenna is not None
    return antenna.stream


def test_the_geometry_is_the_published_one(flight: aar.AarFlight) -> None:
    """Spec aar_two_stage.md, section 3 and check 1: baseline in the tanker's level axes, heights, speeds."""
    t = np.array([0.0, 10.0, 300.0, 1200.0])
    tanker, uav = (flight.record.trajectories[name].at(t) for name in (aar.TANKER, aar.UAV))
    frame = flight.problem.frame
    baseline = np.einsum("nij,nj->ni", frame.C_to_enu(tanker.r_n), uav.r_n - tanker.r_n)
    np.testing.assert_allclose(baseline[0], (-4827, 3081, -99), atol=1.0)
    np.testing.assert_allclose(baseline[2], (37, -75, -10.0), atol=0.5)
    np.testing.assert_allclose(np.linalg.norm(baseline, axis=1)[:3], (5728, 4358, 84), atol=0.5)
    for motion, heights in ((tanker, (7010.0, 7010.0)), (uav, (7000.0, 7000.0))):
        h = geodesy.geodetic_from_ecef(frame.to_ecef(motion.r_n))[2]
        np.testing.assert_allclose(h[2:], heights, atol=0.1)
        np.testing.assert_allclose(np.linalg.norm(motion.v_n, axis=1), 100.0, atol=1e-9)
    pitch, roll, heading = euler_from_matrix(frame.C_to_enu(uav.r_n) @ uav.C_nb)
    np.testing.assert_allclose(np.rad2deg((pitch[2:], roll[2:], heading[2:])), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(heading[:2]), 90.0, atol=1e-9)


@pytest.mark.parametrize("name", [aar.TANKER, aar.UAV])
def test_errorless_inertial_measurements_navigate_the_whole_flight(name: str, known: Exact) -> None:
    """Spec common.md, M2: closure below 0.01 m and 1e-6 rad over 1200 s, kinks of the table included."""
    stream, frame = known.imu[name], aar.scenario().scenario.origin.frame
    assert len(stream.t_s) == 240_001
    keep = np.append(np.arange(0, 240_001, 2000), 240_000)
    true = known.trajectories[name].at(stream.t_s[keep])
    r, v, C = propagate(frame, stream.t_s, stream.f_b, stream.w_b, true.r_n[0], true.v_n[0], true.C_nb[0])
    assert np.max(np.abs(r[keep] - true.r_n)) < 0.01
    assert np.max(np.abs(v[keep] - true.v_n)) < 1e-4
    assert np.max(np.abs(log_so3(C[keep] @ np.swapaxes(true.C_nb, 1, 2)))) < 1e-6


def test_what_is_simulated_is_what_was_published(flight: aar.AarFlight) -> None:
    deg_h, mg = np.pi / 180 / 3600, 9.80665e-3
    for vehicle in flight.problem.vehicles:
        assert vehicle.imu is not None and vehicle.gnss is not None
        stream, noise = vehicle.gnss.stream, vehicle.imu_noise
        np.testing.assert_array_equal(stream.t_s, np.arange(1201.0))
        np.testing.assert_allclose(stream.wavelength_m, 0.192039486, atol=1e-9)
        assert stream.signals == ("C2I",) and stream.klobuchar is None
        assert np.rad2deg(flight.record.gnss[vehicle.name].elevation_rad.min()) >= 25.0
        assert np.max(np.abs(flight.record.gnss[vehicle.name].clock_s)) < 1e-6
        np.testing.assert_allclose((noise.gyro_bias_rps, noise.accel_bias_mps2), (np.hypot(1.0, 0.01) * deg_h, 0.3 * mg))
        np.testing.assert_allclose(noise.gyro_bias_walk_rps_rts, 0.01 * deg_h * np.sqrt(2 / 1500))
        np.testing.assert_allclose(noise.accel_bias_walk_mps2_rts, 0.3 * mg * np.sqrt(2 / 4000))
        record = flight.record.imu[vehicle.name]
        assert 0 < np.ptp(record.gyro_bias_rps, axis=0).max() < 0.1 * deg_h  # nearly constant
        assert np.ptp(record.accel_bias_mps2, axis=0).min() > 0.2 * mg
    other = load_scenario(aar.NAME)
    assert other.vehicle == aar.scenario().vehicle and other.environment == aar.scenario().environment


def test_noise_of_both_readings_is_flat_and_paired(flight: aar.AarFlight) -> None:
    literal = aar.simulate_flight(5, noise="literal")
    a, b = stream_of(flight, aar.UAV), stream_of(literal, aar.UAV)
    el = flight.record.gnss[aar.UAV].elevation_rad
    unit = (b.code_m - a.code_m) / 0.185  # 0.37 - 0.185
    n, low = len(unit), el < np.median(el)
    assert abs(unit.std() - 1) < 4 / np.sqrt(2 * n)
    assert abs(unit[low].std() / unit[~low].std() - 1) < 4 / np.sqrt(n / 2)
    for vehicle, sigma in ((flight, 0.185), (literal, 0.37)):
        told = vehicle.problem.vehicle(aar.UAV).gnss
        assert told is not None and (told.noise.code_m, told.noise.elevation) == (sigma, "flat")
    np.testing.assert_allclose(((b.phase_cyc - a.phase_cyc) * a.wavelength_m).std(), 0.005, rtol=4 / np.sqrt(2 * n))


@pytest.mark.parametrize("start", range(len(aar.START_TIMES)))
def test_every_start_has_ten_or_eleven_satellites(start: int) -> None:
    seen = np.isfinite(aar.true_integers(aar.simulate_flight(0, start)).sd).sum(axis=1)
    assert seen.min() >= 10 and seen.max() <= 11


def test_double_differences_are_geometry_and_the_true_integers(flight: aar.AarFlight) -> None:
    truth = aar.true_integers(flight)
    K, S = truth.sd.shape
    residual = np.full((2, 2, K, S), np.nan)  # vehicle, kind
    for i, name in enumerate((aar.TANKER, aar.UAV)):
        s = stream_of(flight, name)
        clock_s = flight.record.gnss[name].clock_s
        r_n = flight.record.trajectories[name].at(s.t_s - clock_s).r_n
        p = prepare(s, flight.problem.frame, r_n, clock_s, None, flight.problem.t0.sow)
        rho = np.linalg.norm(p.sat_n - r_n[s.epoch], axis=1)
        column = np.array([truth.satellites.index(x) for x in s.satellites])[s.sat]
        residual[i, 0, s.epoch, column] = p.code_m - rho
        residual[i, 1, s.epoch, column] = (p.phase_m - rho) / 0.192039486
    code, phase = residual[1] - residual[0]
    assert np.array_equal(np.isnan(phase), np.isnan(truth.sd))
    pivot = 3
    dd = phase - truth.sd - (phase - truth.sd)[:, [pivot]]
    sigma = 2 * 0.005 / 0.192039486
    others = np.delete(dd, pivot, axis=1).ravel()
    np.testing.assert_allclose(others.std(), sigma, rtol=0.05)
    assert np.max(np.abs(others)) < 6 * sigma
    np.testing.assert_allclose(np.delete(code - code[:, [pivot]], pivot, axis=1).std(), 0.37, rtol=0.05)


def windows(*starts: int) -> list[int]:
    return [t for at in starts for t in range(at, at + 11)]


def test_data_sets_differ_by_their_faults_only(flight: aar.AarFlight) -> None:
    expected = {
        1: ({}, []),
        2: ({5.0: windows(200), 10.0: windows(500), 20.0: windows(800), 40.0: windows(1100)}, []),
        3: ({}, windows(400, 600)),
        4: ({20.0: windows(300, 700)}, windows(300, 700)),
    }
    clean = stream_of(flight, aar.UAV)
    for number, (codes, velocity) in expected.items():
        data = aar.data_set(flight, number)
        hit = data.problem.vehicle(aar.UAV).gnss
        assert hit is not None and data.problem.vehicle(aar.TANKER) is flight.problem.vehicle(aar.TANKER)
        np.testing.assert_array_equal(hit.stream.code_m, clean.code_m + data.code_fault_m)
        for f in fields(GnssStream):
            if f.name != "code_m":
                assert getattr(hit.stream, f.name) is getattr(clean, f.name)
        for size, times in codes.items():
            assert np.unique(clean.epoch[np.abs(data.code_fault_m) == size]).tolist() == times
        assert set(np.unique(np.abs(data.code_fault_m))) == {0.0, *codes}
        assert np.flatnonzero(np.any(data.velocity_fault_mps, axis=1)).tolist() == velocity
        np.testing.assert_allclose(data.velocity_fault_mps[velocity], 5 / np.sqrt(3))
        assert np.flatnonzero(data.faulted).tolist() == sorted({*velocity, *(t for times in codes.values() for t in times)})
    again = aar.data_set(aar.simulate_flight(5), 4)
    np.testing.assert_array_equal(again.code_fault_m, aar.data_set(flight, 4).code_fault_m)
    assert not np.array_equal(again.code_fault_m, aar.data_set(aar.simulate_flight(6), 4).code_fault_m)


def test_inertial_starts_are_drawn_from_their_covariance(flight: aar.AarFlight) -> None:
    problem, uav = flight.problem, flight.problem.vehicle(aar.UAV)
    truth = uav.truth
    assert truth is not None and truth.v_n is not None and truth.q_nb is not None
    C_ln = problem.frame.C_to_enu(truth.r_n[0])
    errors = []
    for seed in range(300):
        s = aar.inertial_start(problem, uav, Streams(seed, "/uav"))
        phi = -log_so3(s.C_nb @ matrix_from_quat(truth.q_nb[0]).T)  # C_est = (I - [phi x]) C_true
        e = np.concatenate([s.r_n - truth.r_n[0], s.v_n - truth.v_n[0], phi])
        errors.append(np.append(e @ np.linalg.solve(s.P, e), np.rad2deg(C_ln @ phi)))
    nees, east, north, up = np.transpose(errors)
    assert abs(nees.mean() - 9) < 4 * np.sqrt(18 / 300)
    for angle, sigma in ((east, 0.05), (north, 0.05), (up, 0.3)):
        np.testing.assert_allclose(angle.std(), sigma, rtol=4 / np.sqrt(600))


def test_unknown_starts_and_data_sets_are_refused(flight: aar.AarFlight) -> None:
    with pytest.raises(InputError, match="start 8: there are 0 to 7"):
        aar.simulate_flight(0, start=8)
    with pytest.raises(InputError, match="data set 5: there are 1, 2, 3, 4"):
        aar.data_set(flight, 5)
