"""Position fixes with velocities and kinds of fix, and vehicles without accelerometers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.measurements import PositionStream
from factorgraph.types import Array
from scenarios.flights.load import load
from scenarios.flights.rtklib_pos import read_pos
from tests.helpers import shared_data
from tests.scenarios.flight_files import FLIGHT, resting_imu, write_csv, write_flight

TITLES = "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn sde sdu sdne sdeu sdun age ratio vn ve vu sdvn sdve sdvu a b c"
ROWS = [
    "2021/09/22 06:30:00.00 35.0000 139.0 50.0 1 9 0.01 0.02 0.03 0 0 0 0 0  1.0 -2.0 0.5 0.1 0.2 0.3 0 0 0",
    "2021/09/22 06:30:00.25 35.0001 139.0 50.0 2 9 0.01 0.02 0.03 0 0 0 0 0  1.1 -2.1 0.6 0.1 0.2 0.3 0 0 0",
    "2021/09/22 06:30:00.50 35.0002 139.0 50.0 1 9 0.01 0.02 0.03 0 0 0 0 0  1.2 -2.2 0.7 0.1 0.2 0.3 0 0 0",
]
POSITIONS = """
[[vehicle]]
name = "uav"
motion = { accel_mps2_rthz = [1.0, 1.0, 1.0] }
[[vehicle.positions]]
file = "fixes.pos"
format = "rtklib-pos"
name = "rtk"
"""


def streams(folder: Path, more: str = "", text: str = POSITIONS) -> tuple[PositionStream, ...]:
    folder.mkdir(exist_ok=True)
    (folder / "fixes.pos").write_text("\n".join([TITLES, *ROWS]) + "\n")
    (folder / "flight.toml").write_text(text + more)
    return load(folder).problem.vehicles[0].positions


def test_velocities_of_a_solution_file_come_with_its_positions(tmp_path: Path) -> None:
    (fixes,) = streams(tmp_path)
    assert fixes.v_n is not None and fixes.sigma_mps is not None
    np.testing.assert_allclose(fixes.v_n, [[-2.0, 1.0, 0.5], [-2.1, 1.1, 0.6], [-2.2, 1.2, 0.7]])
    np.testing.assert_allclose(fixes.sigma_mps[0], [0.2, 0.1, 0.3])
    (without,) = streams(tmp_path, "use_velocity = false")
    assert without.v_n is None


def test_velocities_of_another_time_are_a_stream_of_their_own(tmp_path: Path) -> None:
    fixes, velocities = streams(tmp_path, "velocity_offset_s = -0.125\nsigma_scale = 2.0")
    assert fixes.v_n is None and np.isnan(velocities.r_n).all() and velocities.v_n is not None
    np.testing.assert_allclose(velocities.t_s, fixes.t_s - 0.125)
    np.testing.assert_allclose(fixes.sigma_m[0], [0.04, 0.02, 0.06])
    assert velocities.sigma_mps is not None
    np.testing.assert_allclose(velocities.sigma_mps[0], [0.4, 0.2, 0.6])


def test_velocities_in_ecef(tmp_path: Path) -> None:
    path = tmp_path / "a.pos"
    titles = "%  GPST  x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx sdy sdz sdxy sdyz sdzx age ratio vx vy vz sdvx sdvy sdvz a b c"
    row = "2176 282600.0 6378137.0 0.0 0.0 1 9 0.1 0.1 0.1 0 0 0 0 0 1.0 2.0 3.0 0.1 0.2 0.3 0 0 0"
    path.write_text(f"{titles}\n{row}\n")
    C_en = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # on the equator at longitude zero
    v, cov = read_pos(path).velocity_enu(C_en)
    np.testing.assert_allclose(v, [[2.0, 3.0, 1.0]])
    np.testing.assert_allclose(np.diagonal(cov[0]), [0.04, 0.09, 0.01], atol=1e-12)


def test_only_wanted_kinds_of_fix_are_used(tmp_path: Path) -> None:
    (fixes,) = streams(tmp_path, "qualities = [1]")
    np.testing.assert_allclose(np.diff(fixes.t_s), [0.5])
    report = next(r for r in load(tmp_path).reports if "fixes.pos" in r.source)
    assert report.dropped == {"of another kind of fix": 1}
    with pytest.raises(InputError, match="wanted qualities 4; there are 1, 2"):
        streams(tmp_path, "qualities = [4]")


CSV = """
[flight]
origin = { lat_deg = 47.0, lon_deg = 15.4, h_m = 400.0 }
[[vehicle]]
name = "uav"
motion = { accel_mps2_rthz = [1.0, 1.0, 1.0] }
[[vehicle.positions]]
file = "fixes.csv"
time = "t"
position = ["n", "e", "d"]
frame = "ned"
"""


def test_velocities_and_kinds_from_columns(tmp_path: Path) -> None:
    rows = np.column_stack([np.arange(4.0), np.ones((4, 3)), np.tile([1.0, 2.0, 3.0], (4, 1)), [1, 2, 1, np.nan]])
    write_csv(tmp_path / "fixes.csv", "t,n,e,d,vn,ve,vd,q", rows)
    more = 'velocity = ["vn", "ve", "vd"]\nvelocity_sigma_mps = [0.3, 0.2, 0.1]\nquality = "q"\nqualities = [1]'
    (fixes,) = streams(tmp_path, more, CSV)
    assert fixes.v_n is not None and fixes.sigma_mps is not None
    np.testing.assert_allclose(fixes.v_n, [[2.0, 1.0, -3.0]] * 2)
    np.testing.assert_allclose(fixes.sigma_mps, [[0.3, 0.2, 0.1]] * 2)
    with pytest.raises(InputError, match="qualities needs the column"):
        streams(tmp_path, "qualities = [1]", CSV)


def test_truth_without_attitude_moves_to_the_imu_in_height_only(tmp_path: Path) -> None:
    truth = """
    [vehicle.truth]
    file = "truth.csv"
    time = "t"
    position = ["x", "y", "z"]
    lever_b = [0.5, 0.0, 1.5]
    """
    write_flight(tmp_path, FLIGHT + truth)
    write_csv(tmp_path / "truth.csv", "t,x,y,z", np.column_stack([np.arange(10.0), np.zeros((10, 3))]))
    loaded = load(tmp_path)
    got = loaded.problem.vehicles[0].truth
    assert got is not None
    np.testing.assert_allclose(got.r_n, np.tile([0.0, 0.0, -1.5], (10, 1)))
    assert any("in height only" in note for r in loaded.reports for note in r.notes)


def test_a_level_vehicle_without_accelerometers(tmp_path: Path) -> None:
    imu = resting_imu()
    imu[:, 1:4] = np.nan  # not asked for
    write_flight(tmp_path, FLIGHT.replace('accel = ["ax", "ay", "az"]', 'accel = "level"\naxes = "FRD"'), imu)
    stream = load(tmp_path).problem.vehicles[0].imu
    assert stream is not None and len(stream.t_s) == len(imu)
    np.testing.assert_allclose(stream.f_b, np.tile([0.0, 0.0, 9.80665], (len(imu), 1)), atol=1e-12)
    np.testing.assert_allclose(stream.w_b, imu[:, [5, 4, 6]] * [1, 1, -1])


# recordings: what their descriptions declare, seen in the data itself


@pytest.fixture
def recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RELNAV_DATA", str(shared_data()))


def turned_by(t_s: Array, w: Array, from_s: Array, to_s: Array) -> Array:
    """Integral of a rate between times."""
    total = np.concatenate([[0.0], np.cumsum(0.5 * (w[1:] + w[:-1]) * np.diff(t_s))])
    return np.asarray(np.interp(to_s, t_s, total) - np.interp(from_s, t_s, total))


@pytest.mark.parametrize(("name", "speed", "least"), [("rtklibexplorer-drive", 3.0, 0.97), ("rtklibexplorer-walk", 0.7, 0.7)])
def test_yaw_rates_and_courses_agree(recordings: None, name: str, speed: float, least: float) -> None:
    v = load(name).problem.vehicles[0]
    velocities = v.positions[1]
    assert v.imu is not None and velocities.v_n is not None
    up = v.imu.f_b.mean(axis=0)
    assert up[2] / np.linalg.norm(up) > 0.99
    course = np.unwrap(np.arctan2(velocities.v_n[:, 1], velocities.v_n[:, 0]))  # counterclockwise
    t, moving = velocities.t_s, np.linalg.norm(velocities.v_n[:, :2], axis=1) > speed
    inside = moving[1:] & moving[:-1] & (t[:-1] > v.imu.t_s[0]) & (t[1:] < v.imu.t_s[-1])
    turned = turned_by(v.imu.t_s, v.imu.w_b[:, 2], t[:-1], t[1:])
    assert np.corrcoef(turned[inside], np.diff(course)[inside])[0, 1] > least


def test_the_drive_s_velocities_are_means_since_the_fix_before(recordings: None) -> None:
    fixes, velocities = load("rtklibexplorer-drive").problem.vehicles[0].positions
    assert velocities.v_n is not None
    mean = np.diff(fixes.r_n, axis=0) / np.diff(fixes.t_s)[:, None]
    error = np.median(np.abs(velocities.v_n[1:] - mean), axis=0)
    assert error.max() < 0.04
    assert (np.median(np.abs(velocities.v_n[:-1] - mean), axis=0)[:2] > 2.5 * error[:2]).all()


def forward_lag_s(imu_t_s: Array, f_y: Array, t_s: Array, speed: Array, lags: Array) -> float:
    """Lag at which changes of speed over a second follow the forward specific force best."""
    rows = np.flatnonzero((np.abs(t_s[5:] - t_s[:-5] - 1.0) < 0.01) & (speed[5:] > 3) & (speed[:-5] > 3))
    dv = speed[rows + 5] - speed[rows]
    residual = []
    for lag in lags:
        gained = turned_by(imu_t_s + lag, f_y, t_s[rows], t_s[rows + 5])
        A = np.column_stack([gained, np.ones(len(gained))])
        residual.append(np.linalg.norm(dv - A @ np.linalg.lstsq(A, dv, rcond=None)[0]))
    return float(lags[int(np.argmin(residual))])


def test_the_imu_in_tokyo_fits_with_the_leap_seconds_declared(recordings: None) -> None:
    from scipy.io import loadmat

    problem = load("ixr-tokyo").problem
    imu = problem.vehicles[0].imu
    assert imu is not None
    rtk = loadmat(shared_data("ixr_tokyo_car/RTK1105_posvel.mat"))["GNSSTCData"]
    rtk = rtk[np.unique(rtk[:, 0], return_index=True)[1]]
    rtk = rtk[(rtk[:, 0] - problem.t0.sow > imu.t_s[0] + 20) & (rtk[:, 0] - problem.t0.sow < imu.t_s[-1] - 20)]
    speed = np.linalg.norm(problem.frame.rotate_from_ecef(rtk[:, 5:8])[:, :2], axis=1)
    lags = np.arange(-19.0, 3.0, 0.25)
    assert abs(forward_lag_s(imu.t_s, imu.f_b[:, 1], rtk[:, 0] - problem.t0.sow, speed, lags)) <= 0.25


def test_the_odometer_in_berlin_fits_its_truth(recordings: None) -> None:
    v = load("smartloc-potsdamer").problem.vehicles[0]
    assert v.truth is not None and v.imu is not None
    (odometer,) = v.velocities
    step = np.diff(v.truth.r_n, axis=0)
    speed = np.linalg.norm(step[:, :2], axis=1) / np.diff(v.truth.t_s)
    between = 0.5 * (odometer.v_b[1:, 1] + odometer.v_b[:-1, 1])
    assert np.median(np.abs(speed - between)) < 0.2
    assert (odometer.v_b[:, [0, 2]] == 0).all()
    course = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    middle = 0.5 * (v.truth.t_s[1:] + v.truth.t_s[:-1])
    fast = np.minimum(speed[1:], speed[:-1]) > 3
    turned = turned_by(v.imu.t_s, v.imu.w_b[:, 2], middle[:-1], middle[1:])
    assert np.sum(turned[fast] * np.diff(course)[fast]) / np.sum(turned[fast] ** 2) == pytest.approx(1.0, abs=0.1)


def test_two_antennas_of_a_car_are_a_metre_apart(recordings: None) -> None:
    problem = load("ixr-tokyo-antennas").problem
    front, back = (problem.vehicle(name).positions[0] for name in ("front", "back"))
    _, i, j = np.intersect1d(np.round(front.t_s, 1), np.round(back.t_s, 1), return_indices=True)
    length = np.linalg.norm(front.r_n[i] - back.r_n[j], axis=1)
    assert len(length) == 7935
    assert np.median(length) == pytest.approx(1.036, abs=0.002)
    right = np.abs(length - 1.036) < 0.05  # one epoch is fixed wrongly, by 14 m
    assert right.sum() == 7934 and np.sqrt(np.mean((length[right] - 1.036) ** 2)) < 0.0055
