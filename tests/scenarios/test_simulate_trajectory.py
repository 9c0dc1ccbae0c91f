"""Trajectories: smoothness, attitude along the motion, manoeuvres, formation."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph.attitude import euler_from_matrix, log_so3
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame, geodetic_from_ecef
from scenarios.simulate.trajectory import (
    STANDARD_GRAVITY,
    Formation,
    Kinematic,
    KinematicTrajectory,
    Manoeuvres,
    OffsetAt,
    Push,
    Rates,
    Segment,
    SplineTrajectory,
    Static,
    Trajectory,
    TrajectoryTable,
    Wave,
    Waypoint,
    Waypoints,
    build,
)

FRAME = LocalFrame(np.deg2rad(52.0), np.deg2rad(9.0), 100.0)
TURNS = Manoeuvres(
    kind="manoeuvres",
    start_n=(10.0, 20.0, 100.0),
    speed_mps=30.0,
    heading_deg=350.0,
    segments=(
        Segment(duration_s=20.0),
        Segment(duration_s=15.0, turn_dps=6.0),
        Segment(duration_s=15.0, accel_mps2=0.4),
        Segment(duration_s=20.0, bank_deg=-30.0, climb_mps=2.0),
        Segment(duration_s=20.0),
    ),
)

PLACE = {"lat_deg": 52.3, "lon_deg": 9.4, "h_m": 3000.0, "speed_mps": 60.0}
AEROBATICS = Kinematic(
    kind="kinematic",
    **PLACE,
    heading_deg=170.0,
    pitch_deg=3.0,
    roll_deg=-8.0,
    segments=(
        Rates(duration_s=20.0, roll_dps=0.5),
        Rates(duration_s=30.0, yaw_dps=3.0, accel_mps2=0.2),
        Rates(duration_s=40.0, pitch_dps=-0.4, roll_dps=1.0),
    ),
)


def built(**tables: TrajectoryTable) -> dict[str, Trajectory]:
    return build(dict(tables), 90.0, {name: np.random.default_rng(3) for name in tables}, FRAME)


def test_derivatives_are_continuous_and_agree_with_the_motion() -> None:
    paths = built(a=TURNS, b=Formation(kind="formation", leader="a", offset_m=(20.0, -30.0, 5.0), sway_m=2.0))
    t, h = np.arange(1.0, 89.0, 0.05), 1e-4
    for path in paths.values():
        before, here, after = path.at(t - h), path.at(t), path.at(t + h)
        np.testing.assert_allclose((after.r_n - before.r_n) / (2 * h), here.v_n, atol=1e-6)
        rate = log_so3(np.swapaxes(before.C_nb, 1, 2) @ after.C_nb) / (2 * h)
        np.testing.assert_allclose(rate, here.w_nb_b, atol=1e-6)
        assert isinstance(path, SplineTrajectory)
        for spline in (path.position, path.angles):
            for order in range(5):  # splines of degree 5 on simple knots jump in the fifth derivative only
                step = spline(t + 1e-9, order) - spline(t - 1e-9, order)
                assert np.max(np.abs(step)) < 1e-5 * (1 + np.max(np.abs(spline(t, order + 1 if order < 4 else 4))))


def test_manoeuvres_turn_accelerate_and_climb_as_told() -> None:
    path = built(a=TURNS)["a"]
    start, straight, turned, faster, end = (path.at(np.array([t])) for t in (5.0, 15.0, 42.0, 52.0, 85.0))
    np.testing.assert_allclose(path.at(np.zeros(1)).r_n[0], TURNS.start_n, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(start.v_n), 30.0, atol=1e-6)
    heading = [float(euler_from_matrix(m.C_nb)[2][0]) for m in (straight, turned)]
    np.testing.assert_allclose(np.rad2deg(heading[1] - heading[0]) % 360, 90.0, atol=0.1)
    np.testing.assert_allclose(np.linalg.norm(faster.v_n[:, :2]), 36.0, atol=0.1)
    np.testing.assert_allclose(end.r_n[0, 2] - straight.r_n[0, 2], 40.0, atol=0.1)


def test_coordinated_flight_feels_no_side_force_and_points_along_the_track() -> None:
    path = built(a=TURNS)["a"]
    t = np.arange(0.0, 90.0, 0.1)
    motion = path.at(t)
    force = path.position(t, 2) + np.array([0.0, 0.0, STANDARD_GRAVITY])
    sideways = np.einsum("nij,ni->nj", motion.C_nb, force)[:, 0]
    assert np.max(np.abs(sideways)) < 0.05  # exact where the climb is level
    pitch, roll, heading = euler_from_matrix(motion.C_nb)
    np.testing.assert_allclose(np.exp(1j * heading), np.exp(1j * np.arctan2(motion.v_n[:, 0], motion.v_n[:, 1])), atol=1e-4)
    np.testing.assert_allclose(np.rad2deg(roll[np.searchsorted(t, 60.0)]), -30.0, atol=0.3)
    np.testing.assert_allclose(np.tan(pitch), motion.v_n[:, 2] / np.hypot(*motion.v_n[:, :2].T), atol=1e-3)


def test_a_follower_holds_its_offsets_in_the_track_frame() -> None:
    offsets = (OffsetAt(t_s=10.0, offset_m=(30.0, -40.0, 5.0)), OffsetAt(t_s=60.0, offset_m=(-20.0, -10.0, 0.0)))
    paths = built(b=Formation(kind="formation", leader="a", offsets=offsets), a=TURNS)
    assert list(paths) == ["b", "a"]
    for t, offset in ((5.0, offsets[0]), (80.0, offsets[1])):
        leader, follower = paths["a"].at(np.array([t])), paths["b"].at(np.array([t]))
        psi = paths["a"].euler(np.array([t]))[0, 2]
        right, front = np.array([np.cos(psi), -np.sin(psi), 0.0]), np.array([np.sin(psi), np.cos(psi), 0.0])
        d = (follower.r_n - leader.r_n)[0]
        np.testing.assert_allclose((d @ right, d @ front, d[2]), offset.offset_m, atol=1e-3)


def test_a_follower_swings_and_is_pushed_aside_and_comes_back() -> None:
    """Waves are sines about the offset; a push is its acceleration for its time, then a smooth way back, at rest there."""
    straight = Manoeuvres(kind="manoeuvres", speed_mps=30.0, heading_deg=30.0, segments=(Segment(duration_s=90.0),))
    wave = Wave(size_m=(0.0, 1.0, 4.0), period_s=20.0, phase_deg=90.0)
    push = Push(t_s=40.0, duration_s=3.0, accel_mps2=(2.0, 0.0, 0.0), back_s=25.0)
    paths = built(
        leader=straight,
        swings=Formation(kind="formation", leader="leader", offset_m=(10.0, -30.0, 5.0), waves=(wave,)),
        pushed=Formation(kind="formation", leader="leader", offset_m=(10.0, -30.0, 5.0), pushes=(push,)),
    )
    t = np.arange(0.0, 90.01, 0.05)
    C = np.array([[np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0], [-np.sin(np.pi / 6), np.cos(np.pi / 6), 0.0], [0.0, 0.0, 1.0]])
    swings, pushed = (
        (paths[name].at(t).r_n - paths["leader"].at(t).r_n) @ C - [10.0, -30.0, 5.0] for name in ("swings", "pushed")
    )
    np.testing.assert_allclose(swings, np.cos(2 * np.pi * t / 20.0)[:, None] * [0.0, 1.0, 4.0], atol=1e-4)
    assert np.max(np.abs(pushed[:, 1:])) < 1e-6
    way, speed = pushed[:, 0], np.gradient(pushed[:, 0], t)
    accel = np.gradient(speed, t)
    away = (t < 39.5) | (t > 68.5)
    assert np.max(np.abs(way[away])) < 1e-6
    np.testing.assert_allclose(accel[(t > 40.5) & (t < 42.5)], 2.0, atol=0.02)
    assert way[t.searchsorted(43.0)] == pytest.approx(9.0, abs=0.1) and speed[t.searchsorted(43.3)] == pytest.approx(6.0, abs=0.2)
    assert way.min() > -0.5 and way.max() < 40.0 and np.max(np.abs(accel)) < 2.5
    _, roll, _ = euler_from_matrix(paths["pushed"].at(np.array([41.5])).C_nb)
    assert float(np.tan(roll[0])) == pytest.approx(2.0 / STANDARD_GRAVITY, rel=0.02)


def test_waypoints_are_passed_at_their_times() -> None:
    points = tuple(
        Waypoint(t_s=t, r_n=r) for t, r in ((0, (0, 0, 0)), (30, (600, 50, 20)), (60, (900, 700, 20)), (90, (800, 1400, 0)))
    )
    path = built(a=Waypoints(kind="waypoints", points=points))["a"]
    for p in points:
        np.testing.assert_allclose(path.at(np.array([p.t_s])).r_n[0], p.r_n, atol=1e-6)


def test_kinematic_flight_follows_its_table_over_the_ellipsoid() -> None:
    """Position against a fine midpoint integration of the geodetic rates, angles against the local level."""
    path = built(a=AEROBATICS)["a"]
    t = np.linspace(0.0, 90.0, 9001)
    speed = np.interp(t, [0, 20, 50, 90], [60, 60, 66, 66])
    pitch, roll, heading = (
        np.deg2rad(np.interp(t, [0, 20, 50, 90], x)) for x in ([3, 3, 3, -13], [-8, 2, 2, 42], [170, 170, 260, 260])
    )
    motion = path.at(t)
    C_ln = FRAME.C_to_enu(motion.r_n)
    for got, want in zip(euler_from_matrix(C_ln @ motion.C_nb), (pitch, roll, heading), strict=True):
        np.testing.assert_allclose(np.exp(1j * got), np.exp(1j * want), atol=1e-12)
    v = np.einsum("nij,nj->ni", C_ln, motion.v_n)
    level = speed * np.cos(pitch)
    want = np.column_stack([level * np.sin(heading), level * np.cos(heading), speed * np.sin(pitch)])
    np.testing.assert_allclose(v, want, atol=1e-9)
    start = geodetic_from_ecef(FRAME.to_ecef(motion.r_n[0]))
    np.testing.assert_allclose(start, (np.deg2rad(52.3), np.deg2rad(9.4), 3000.0), rtol=1e-12)
    moved = np.cumsum(np.vstack([np.zeros(3), 0.005 * (motion.v_n[1:] + motion.v_n[:-1])]), axis=0)  # trapezoids
    np.testing.assert_allclose(motion.r_n - motion.r_n[0], moved, atol=2e-3)


def test_kinematic_rates_and_velocities_are_derivatives_also_around_the_ends() -> None:
    path = built(a=AEROBATICS)["a"]
    assert isinstance(path, KinematicTrajectory)
    t, h = np.arange(-1.95, 91.9, 0.1), 1e-3
    before, here, after = path.at(t - h), path.at(t), path.at(t + h)
    np.testing.assert_allclose((after.r_n - before.r_n) / (2 * h), here.v_n, atol=1e-5)
    rate = log_so3(np.swapaxes(before.C_nb, 1, 2) @ after.C_nb) / (2 * h)
    np.testing.assert_allclose(rate, here.w_nb_b, atol=1e-7)
    angles = path.euler(t)
    np.testing.assert_allclose(np.exp(1j * angles), np.exp(1j * np.column_stack(euler_from_matrix(here.C_nb))), atol=1e-12)
    assert np.max(np.abs(np.diff(angles[:, 2]))) < 0.01


def test_a_follower_holds_its_place_beside_kinematic_flight() -> None:
    paths = built(b=Formation(kind="formation", leader="a", frame="body", offset_m=(5.0, -20.0, 1.0)), a=AEROBATICS)
    leader, follower = (paths[name].at(np.arange(5.0, 15.0)) for name in ("a", "b"))
    at = np.einsum("nji,nj->ni", leader.C_nb, follower.r_n - leader.r_n)
    np.testing.assert_allclose(at, np.tile((5.0, -20.0, 1.0), (10, 1)), atol=1e-6)


def test_rest_and_standstill_keep_the_heading() -> None:
    stop = Manoeuvres(kind="manoeuvres", heading_deg=40.0, segments=(Segment(duration_s=90.0),), attitude="level")
    paths = built(a=Static(kind="static", r_n=(1.0, 2.0, 3.0), heading_deg=-100.0), b=stop)
    for name, heading in (("a", -100.0), ("b", 40.0)):
        motion = paths[name].at(np.array([0.0, 50.0]))
        np.testing.assert_allclose(np.rad2deg(euler_from_matrix(motion.C_nb)[2]), heading)
        assert np.max(np.abs(motion.v_n)) < 1e-9


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (Formation(kind="formation", leader="z", offset_m=(0, 0, 0)), "cannot follow z: there are a"),
        (Formation(kind="formation", leader="a", offset_m=(0, 0, 0)), "in a circle"),
        (Waypoints(kind="waypoints", points=(Waypoint(t_s=0, r_n=(0, 0, 0)), Waypoint(t_s=50, r_n=(9, 9, 9)))), "span 0 to 50 s"),
        (Waypoints(kind="waypoints", points=tuple(Waypoint(t_s=t, r_n=(t, 0, 0)) for t in (0, 50, 50, 90))), "must increase"),
        (Manoeuvres(kind="manoeuvres", segments=(Segment(duration_s=9.0),)), "repeat = true"),
        (Kinematic(kind="kinematic", **PLACE, segments=(Rates(duration_s=9.0),)), "its segments last 9 of 90 s"),
        (Kinematic(kind="kinematic", **PLACE, segments=(Rates(duration_s=90.0, accel_mps2=-1.0),)), "slow it down"),
        (Manoeuvres(kind="manoeuvres", speed_mps=5, segments=(Segment(duration_s=90.0, accel_mps2=-1),)), "slow it down"),
    ],
)
def test_impossible_motions_are_explained(table: TrajectoryTable, message: str) -> None:
    with pytest.raises(InputError, match=message):
        built(a=table)
