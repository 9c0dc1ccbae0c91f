"""The published flight of two UAVs in close company: geometry, sky, sensors, attitude systems, formations, attitude filters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factorgraph.attitude import log_so3, matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.geodesy import geodetic_from_ecef
from factorgraph.models.strapdown import propagate
from factorgraph.types import Array
from scenarios.published import ahrs_tdo
from scenarios.published.ahrs_tdo import ASSUMED, FOLLOWER, LEADER, MANOEUVRES, AhrsTdoFlight
from scenarios.simulate.trajectory import Formation

G = 9.80665
DEG_H = np.pi / 180 / 3600


@pytest.fixture(scope="module")
def flight() -> AhrsTdoFlight:
    return ahrs_tdo.simulate_flight(5, magnetometers=True)


def in_track(flight: AhrsTdoFlight, t: Array) -> Array:
    """Follower - leader (n, 3): right, front, up of the leader's track."""
    leader, follower = (flight.record.trajectories[name] for name in (LEADER, FOLLOWER))
    d, psi = follower.at(t).r_n - leader.at(t).r_n, leader.euler(t)[:, 2]
    c, s = np.cos(psi), np.sin(psi)
    return np.column_stack([c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1], d[:, 2]])


def test_the_leader_flies_the_stated_figures(flight: AhrsTdoFlight) -> None:
    """Spec ahrs_tdo.md, section 3: start, speed, climb, 180 deg at 3 deg/s, S-turns of 45 deg, descent."""
    leader, frame = flight.record.trajectories[LEADER], flight.problem.frame
    lat, lon, h = geodetic_from_ecef(frame.to_ecef(leader.at(np.zeros(1)).r_n))
    np.testing.assert_allclose((np.rad2deg(lat[0]), np.rad2deg(lon[0]), h[0]), (32.0, 118.8, 1000.0), atol=1e-9)
    t = np.array([30.0, 110.0, 190.0, 260.0, 310.0, 320.0, 360.0, 400.0, 460.0, 550.0])
    motion, turned = leader.at(t), np.rad2deg(leader.euler(t)[:, 2])
    np.testing.assert_allclose(np.hypot(motion.v_n[:, 0], motion.v_n[:, 1]), 50.0, atol=1e-3)
    np.testing.assert_allclose(motion.v_n[:, 2], (0, 5, 0, 0, 0, 0, 0, 0, -5, 0), atol=1e-6)
    np.testing.assert_allclose(turned[[0, 1, 3, 8, 9]] - turned[0], (0, 0, 180, 180, 180), atol=0.5)
    np.testing.assert_allclose(turned[5:8] - turned[3], (45, -45, 45), atol=2.0)  # blended
    np.testing.assert_allclose(np.diff(np.rad2deg(leader.euler(np.array([189.0, 191.0]))[:, 2])), 6.0, atol=1e-3)


def test_the_follower_keeps_its_place_but_for_two_pushes(flight: AhrsTdoFlight) -> None:
    t = np.arange(0.0, 600.1, 0.1)
    d = in_track(flight, t)
    np.testing.assert_allclose(d[:, 2], -10.0 + 10.0 * np.sin(2 * np.pi * t / 60.0), atol=1e-3)
    np.testing.assert_allclose(d[:, 1], -80.0, atol=1e-3)
    pushed = np.abs(d[:, 0] - 30.0) > 0.01
    np.testing.assert_allclose([t[pushed][0], t[pushed & (t < 400)][-1], t[pushed & (t > 400)][0], t[pushed][-1]],
                               (250, 278, 450, 478), atol=1.5)  # fmt: skip
    accel = np.gradient(np.gradient(d[:, 0], t), t)
    for start, end in MANOEUVRES:
        np.testing.assert_allclose(accel[(t > start + 0.5) & (t < end - 0.5)], 2.0, atol=0.02)
    inside = ahrs_tdo.manoeuvring(np.arange(601.0))
    assert np.flatnonzero(inside).tolist() == [250, 251, 252, 253, 450, 451, 452, 453]


def test_eight_satellites_are_seen_all_along_and_nobody_has_phases(flight: AhrsTdoFlight) -> None:
    for vehicle in flight.problem.vehicles:
        assert vehicle.gnss is not None
        stream, noise = vehicle.gnss.stream, vehicle.gnss.noise
        assert set(np.bincount(stream.epoch)) == {8} and len(stream.t_s) == 601 and stream.signals == ("G1C",)
        assert np.rad2deg(flight.record.gnss[vehicle.name].elevation_rad.min()) >= 15.0
        assert np.all(np.isnan(stream.phase_cyc)) and not np.any(stream.lli)
        assert (noise.code_m, noise.absolute_code_m, noise.doppler_mps, noise.elevation) == (3.0, 3.0, 0.03, "flat")
    drawn = flight.simulated.problem.vehicle(LEADER).gnss
    assert drawn is not None and np.all(np.isfinite(drawn.stream.phase_cyc))


def test_sensors_are_as_published_and_as_told(flight: AhrsTdoFlight) -> None:
    model = ahrs_tdo.imu_model()
    for vehicle in flight.problem.vehicles:
        assert vehicle.imu is not None
        noise, errors = vehicle.imu_noise, flight.record.imu[vehicle.name]
        np.testing.assert_allclose(noise.gyro_rps_rthz * 10.0, 0.1 * DEG_H)  # of a sample at 100 Hz
        np.testing.assert_allclose((noise.gyro_bias_rps, noise.accel_bias_mps2), (np.hypot(0.1, 0.1) * DEG_H, 0.01 * G))
        np.testing.assert_allclose(noise.accel_bias_walk_mps2_rts, 0.01 * G * np.sqrt(2 / 3600))
        np.testing.assert_allclose((model.gyro_constant_rps, model.gyro_markov_rps), 0.1 * DEG_H)
        np.testing.assert_allclose((model.accel_markov_mps2, model.accel_markov_s), (0.01 * G, 3600.0))
        true = ahrs_tdo._exact(2, "v").imu[vehicle.name]
        white = np.diff(vehicle.imu.w_b - true.w_b - errors.gyro_bias_rps, axis=0).std() / np.sqrt(2)
        assert white == pytest.approx(0.1 * DEG_H, rel=0.02)
    uwb = flight.problem.ranges[0]
    off = uwb.stream.range_m - flight.record.ranges[0].true_m
    assert len(off) == 601 and np.mean(off) == pytest.approx(1e-3 * 92.0, abs=0.03) and off.std() == pytest.approx(0.15, rel=0.1)
    assert uwb.scale_sigma == 1e-3 and ahrs_tdo.scenario(told_scale=0.0).range[0].scale_sigma == 0.0


def test_assumptions_are_those_of_the_scenario() -> None:
    leader, follower = ahrs_tdo.scenario().vehicle
    (uwb,) = ahrs_tdo.scenario().range
    assert leader.imu is not None and isinstance(follower.trajectory, Formation)
    noise = leader.imu.noise
    assert (leader.imu.accel_gm_s, noise.accel_ug_rthz, uwb.scale_ppm) == (ASSUMED.accel_s, ASSUMED.accel_white_ug_rthz, 1000.0)
    assert noise.gyro_deg_h_rthz == pytest.approx(ASSUMED.gyro_white_deg_h / np.sqrt(leader.imu.rate_hz))
    assert follower.trajectory.offset_m == ASSUMED.place_m and ASSUMED.crystal == 1e-6 * uwb.scale_ppm
    table = leader.attitudes[0]
    assert (table.gm_deg, table.gm_s, table.sigma_deg) == (ASSUMED.ahrs_deg, ASSUMED.ahrs_s, (ASSUMED.ahrs_white_deg,) * 3)
    assert leader.imu == follower.imu and leader.gnss == follower.gnss and leader.attitudes == follower.attitudes


def test_errorless_samples_navigate_the_whole_flight(flight: AhrsTdoFlight) -> None:
    known, frame = ahrs_tdo._exact(2, "v"), flight.problem.frame
    for name, stream in known.imu.items():
        keep = np.append(np.arange(0, 60_001, 2500), 60_000)
        true = known.trajectories[name].at(stream.t_s[keep])
        r, v, C = propagate(frame, stream.t_s, stream.f_b, stream.w_b, true.r_n[0], true.v_n[0], true.C_nb[0])
        assert np.max(np.abs(r[keep] - true.r_n)) < 0.01 and np.max(np.abs(v[keep] - true.v_n)) < 1e-4
        assert np.max(np.abs(log_so3(C[keep] @ np.swapaxes(true.C_nb, 1, 2)))) < 1e-6


def test_attitude_systems_err_as_assumed(flight: AhrsTdoFlight) -> None:
    errors = []
    for name in (LEADER, FOLLOWER):
        stream = flight.ahrs(name)
        assert len(stream.t_s) == 60_001
        true = flight.record.trajectories[name].at(stream.t_s).C_nb
        error = log_so3(matrix_from_quat(stream.q_nb) @ np.swapaxes(true, 1, 2))
        np.testing.assert_allclose(error, flight.record.sensors[f"{name}/ahrs"].rotation_n, atol=1e-12)
        errors.append(error)
    sigma = np.rad2deg(np.concatenate(errors).std(axis=0))
    np.testing.assert_allclose(sigma, np.hypot(ASSUMED.ahrs_deg, ASSUMED.ahrs_white_deg), rtol=0.15)


def test_both_accelerometers_share_their_random_numbers(flight: AhrsTdoFlight) -> None:
    better = ahrs_tdo.simulate_flight(5, "0.1mg")
    for name in (LEADER, FOLLOWER):
        ratio = flight.record.imu[name].accel_bias_mps2 / better.record.imu[name].accel_bias_mps2
        np.testing.assert_allclose(ratio, 100.0)
        np.testing.assert_array_equal(flight.ahrs(name).q_nb, better.ahrs(name).q_nb)
    assert ahrs_tdo.imu_model("0.1mg").accel_markov_mps2 == pytest.approx(1e-4 * G)


def test_up_to_ten_fly_together(flight: AhrsTdoFlight) -> None:
    """Places, links and ranges of formations; the first follower is the published one, its random numbers, too."""
    flown = ahrs_tdo.simulate_flight(flight.seed, n=3, ranges="ring")
    assert flown.followers == (FOLLOWER, "follower-2") and flight.followers == (FOLLOWER,)
    assert [(k.reference, k.rover) for k in flown.problem.links] == [(LEADER, name) for name in flown.followers]
    names = [model.stream.name for model in flown.problem.ranges]
    assert names == ["uwb-leader-follower", "uwb-follower-follower-2", "uwb-follower-2-leader"]
    assert all(np.array_equal(model.stream.t_s, np.arange(601.0)) for model in flown.problem.ranges)
    assert len(ahrs_tdo.scenario(n=10).range) == 45
    places = [v.trajectory.offset_m for v in ahrs_tdo.formation(5) if isinstance(v.trajectory, Formation)]
    assert places == [(30, -80, -10), (-30, -80, -10), (60, -160, -20), (-60, -160, -20)]
    line = [v.trajectory.offset_m for v in ahrs_tdo.formation(3, "line") if isinstance(v.trajectory, Formation)]
    assert line == [(0, -80, 0), (0, -160, 0)]
    one, two = (f.problem.vehicle(FOLLOWER).gnss for f in (flight, flown))
    assert one is not None and two is not None
    np.testing.assert_array_equal(one.stream.code_m, two.stream.code_m)


@pytest.mark.parametrize("aided", [False, True])
def test_attitude_filters_hold_through_the_turns(flight: AhrsTdoFlight, aided: bool) -> None:
    """Errors of the flight below what accelerometer bias and hard iron leave; the gate alone lets turns through."""
    tracks = ahrs_tdo.attitude_filters(flight, aided)
    for name, track in tracks.items():
        true = flight.record.trajectories[name].at(track.t_s[::50]).C_nb
        off = np.rad2deg(log_so3(matrix_from_quat(track.q_nb[::50]) @ np.swapaxes(true, 1, 2)))
        assert np.all(np.sqrt(np.mean(off**2, axis=0)) < (1.2, 1.2, 2.2))
        assert 0.9 < track.gravity_used.mean()
    streams = {name: track.stream(100.0) for name, track in tracks.items()}
    other = ahrs_tdo.with_attitudes(flight, streams)
    assert other.ahrs(LEADER) is streams[LEADER] and other.problem.ranges is flight.problem.ranges


def test_what_does_not_exist_is_named(flight: AhrsTdoFlight) -> None:
    bare = replace(flight.problem, vehicles=tuple(replace(v, magnetics=()) for v in flight.problem.vehicles))
    blind = replace(flight, problem=bare)
    cases = (
        (lambda: ahrs_tdo.scenario("1g"), r"accel must be one of 0\.01g, 0\.1mg, got 1g"),  # type: ignore[arg-type]
        (lambda: ahrs_tdo.formation(11), "n must be 2 to 10 vehicles, got 11"),
        (lambda: ahrs_tdo.formation(3, "w"), "shape must be one of v, line, got w"),  # type: ignore[arg-type]
        (lambda: ahrs_tdo.scenario(n=3, ranges="star"), "ranges must be one of all, ring"),  # type: ignore[arg-type]
        (lambda: ahrs_tdo.attitude_filters(blind), "vehicle leader: an attitude filter needs an IMU"),
    )
    for call, message in cases:
        with pytest.raises(InputError, match=message):
            call()
