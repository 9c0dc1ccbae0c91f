"""flight.toml: keys, units, axes, errors, and writing it back."""

from __future__ import annotations

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime
from factorgraph.problem import ImuNoise, Robust, Settings
from scenarios.flights.schema import FlightInfo, Imu, Mounting, axes_matrix, dump, parse

FULL = """
[flight]
name = "full"
t0 = "2021-09-22T06:30:00.5"
origin = { lat_deg = 47, lon_deg = 15, h_m = 400, heading_deg = 30 }
end_s = 100

[[vehicle]]
name = "uav.1 \\"red\\""
axes = "FLU"
imu = { file = "imu.csv", time = { column = "t", unit = "ms" }, axes = "FLU", mounting = { rpy_deg = [180, 0, -90] } }
imu_noise = { gyro_deg_rth = 0.3, accel_ug_rthz = 100.0, accel_bias_mg = 5 }
gnss = { obs = "a.obs", nav = "a.nav", noise = { elevation_mask_deg = 10 } }
positions = [{ file = "p.csv", time = 0 }, { file = "p.nmea", format = "nmea", date = "2021-09-22" }]
heights = [{ constant_m = 0.0 }]
motion = { accel_mps2_rthz = [1, 1, 0.5] }
truth = { file = "t.csv", position = [1, 2] }

[[vehicle]]
name = "base"
fixed = { lat_deg = 47, lon_deg = 15, h_m = 400 }

[[range]]
files = "r.csv"
tags = [{ name = "1", vehicle = "base" }, { name = "2", position_m = [1, 2, 3] }]
scale_sigma = 0.1

[[link]]
reference = "base"
rover = "base"

[settings]
systems = "GE"
ambiguity = { fix = false }
robust = { code = { width = 3 } }
"""


def test_everything_declared_is_understood() -> None:
    flight = parse(FULL)
    uav = flight.vehicle[0]
    assert flight.flight.t0 == GpsTime.from_calendar(2021, 9, 22, 6, 30, 0.5)
    assert uav.imu is not None and uav.imu.time.column == "t" and uav.imu.time.unit == "ms"
    assert uav.gnss is not None and uav.gnss.nav == ("a.nav",)
    assert uav.gnss.noise.noise.elevation_mask_rad == pytest.approx(np.deg2rad(10))
    assert uav.positions[0].time.column == 0
    assert flight.problem_settings.robust["code"] == Robust("dcs", 3.0)
    assert flight.problem_settings.robust["phase"] == Settings().robust["phase"]
    assert not flight.problem_settings.ambiguity.fix


def test_a_dumped_flight_reads_back_equal() -> None:
    flight = parse(FULL)
    text = dump(flight)
    assert parse(text) == flight
    assert dump(parse(text)) == text
    assert "delimiter" not in text  # defaults are left out


def test_data_sheet_units() -> None:
    noise = parse(FULL).vehicle[0].imu_noise.noise
    assert noise.gyro_rps_rthz == pytest.approx(0.3 * 2.9088821e-4, rel=1e-7)
    assert noise.accel_mps2_rthz == pytest.approx(100 * 9.80665e-6)
    assert noise.accel_bias_mps2 == pytest.approx(5 * 9.80665e-3)
    assert noise.gyro_bias_rps == ImuNoise().gyro_bias_rps


@pytest.mark.parametrize(
    ("axes", "columns"),
    [
        ("RFU", ((1, 0, 0), (0, 1, 0), (0, 0, 1))),
        ("FRD", ((0, 1, 0), (1, 0, 0), (0, 0, -1))),
        ("FLU", ((0, 1, 0), (-1, 0, 0), (0, 0, 1))),
    ],
)
def test_axes(axes: str, columns: tuple[tuple[int, int, int], ...]) -> None:
    np.testing.assert_array_equal(axes_matrix(axes), np.column_stack(columns))


def test_mounting_angles_turn_the_sensor_whatever_its_axes_are_called() -> None:
    """Yaw 90 deg: the sensor's front points to the body's right; roll 180 deg: its up points down."""
    for axes, front, up in (("RFU", (0, 1, 0), (0, 0, 1)), ("FRD", (1, 0, 0), (0, 0, -1)), ("FLU", (1, 0, 0), (0, 0, 1))):
        yawed = Imu(file="x", axes=axes, mounting=Mounting(rpy_deg=(0, 0, 90)))
        rolled = Imu(file="x", axes=axes, mounting=Mounting(rpy_deg=(180, 0, 0)))
        np.testing.assert_allclose(yawed.C_bs @ np.array(front), [1, 0, 0], atol=1e-12)
        np.testing.assert_allclose(rolled.C_bs @ np.array(up), [0, 0, -1], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "telling"),
    [
        ('axes = "FLU"', 'axes = "FLD"', "vehicle[0].axes: axes \"FLD\" are left-handed"),
        ('axes = "FLU"', 'axes = "FFU"', "name one direction twice"),
        ('axes = "FLU"', 'axes = "XYZ"', "write three of R L F B U D"),
        ("rpy_deg", "rpydeg", "vehicle[0].imu.mounting: unknown key rpydeg; did you mean rpy_deg?"),
        ('unit = "ms"', 'unit = "min"', "vehicle[0].imu.time.unit"),
        ('column = "t"', "column = -1", "a column is a name or a number from 0"),
        ("gyro_deg_rth = 0.3", "gyro_deg_rth = -0.3", "vehicle[0].imu_noise.gyro_deg_rth"),
        ("gyro_deg_rth = 0.3", "gyro_deg_rth = 0.3, gyro_rps_rthz = 1e-4", "state the same quantity"),
        ("obs = ", "observation = ", "vehicle[0].gnss: unknown key observation"),
        ("constant_m = 0.0", "sigma_m = 1.0", "give either file or constant_m"),
        ("position = [1, 2]", "position = [1]", "name two or three columns"),
        ('fixed = { lat_deg = 47, lon', "fixed = { lon", "lat_deg with lon_deg and h_m"),
        ("position_m = [1, 2, 3]", 'position_m = [1, 2, 3], vehicle = "base"', "tag 2: give either vehicle"),
        ("t0 = \"2021", "t0 = \"21", "flight.t0: write t0 as"),
        ("06:30:00.5", "06:30:00Z", "without a time zone"),
        ('systems = "GE"', 'system = "GE"', "unknown key system; did you mean systems?"),
        ('systems = "GE"', 'systems = "GPS"', "must hold letters of GREJC"),
        ("fix = false", 'fix = "perhaps"', "ambiguity.fix"),
        ("width = 3", "width = 0", "Robust.width must be positive"),
        ("code = {", "cod = {", "unknown key robust.cod; did you mean code?"),
        ('name = "base"', "", "vehicle[1].name: this key is needed"),
        ("[[link]]", "[[links]]", "unknown key links; did you mean link?"),
        ("[settings]", "[settings", "line"),
    ],
)  # fmt: skip
def test_errors_name_file_key_and_remedy(old: str, new: str, telling: str) -> None:
    assert old in FULL
    with pytest.raises(InputError) as error:
        parse(FULL.replace(old, new, 1), "my/flight.toml")
    assert str(error.value).startswith("my/flight.toml: ")
    assert telling in str(error.value)
    assert "\n" not in str(error.value)


def test_a_matrix_that_is_no_rotation_is_refused() -> None:
    with pytest.raises(ValueError, match="right-handed rotation"):
        Mounting(matrix=((1, 0, 0), (0, 1, 0), (0, 0, -1)))


def test_week_and_seconds_as_t0() -> None:
    assert FlightInfo.model_validate({"t0": {"week": 2176, "sow": 282600.25}}).t0 == GpsTime(2176, 282600.25)
