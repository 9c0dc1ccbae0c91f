"""IMU, ranges and fixes: exact without noise, each error source as predicted."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from factorgraph.attitude import log_so3
from factorgraph.errors import InputError
from factorgraph.geodesy import LocalFrame
from factorgraph.measurements import ImuStream
from factorgraph.models.strapdown import propagate
from factorgraph.types import Array
from scenarios.flights.schema import ImuNoiseTable, TagTable
from scenarios.simulate import fixes, imu, ranging
from scenarios.simulate.streams import Streams, gauss_markov
from scenarios.simulate.trajectory import Manoeuvres, Motion, Segment, Static, Trajectory, build

FRAME = LocalFrame(np.deg2rad(50.0), np.deg2rad(8.0), 300.0)
QUIET = ImuNoiseTable(
    gyro_rps_rthz=1e-12, accel_mps2_rthz=1e-12, gyro_bias_rps=1e-12, accel_bias_mps2=1e-12,
    gyro_bias_walk_rps_rts=1e-15, accel_bias_walk_mps2_rts=1e-15,
)  # fmt: skip
STREAMS = Streams(5, "/a")


def flight(duration_s: float, turn_dps: float = 0.0) -> dict[str, Trajectory]:
    moving = Manoeuvres(kind="manoeuvres", speed_mps=25.0, segments=(Segment(duration_s=duration_s, turn_dps=turn_dps),))
    resting = Static(kind="static", r_n=(40.0, -300.0, 10.0), heading_deg=30.0)
    rng = np.random.default_rng(0)
    return build({"a": moving, "b": resting}, duration_s, {"a": rng, "b": rng}, FRAME)


def sensed(table: imu.ImuTable, path: Trajectory, duration_s: float, scale: float = 1.0) -> tuple[ImuStream, imu.ImuRecord]:
    return imu.simulate(table, imu.exact(table, path, FRAME, duration_s), STREAMS, scale)


def navigated(table: imu.ImuTable, path: Trajectory, duration_s: float) -> tuple[Array, Array, Array, Motion]:
    """Position, velocity and attitude errors after propagation from the true start."""
    stream, _ = sensed(table, path, duration_s)
    true = path.at(stream.t_s)
    r, v, C = propagate(FRAME, stream.t_s, stream.f_b, stream.w_b, true.r_n[0], true.v_n[0], true.C_nb[0])
    return r - true.r_n, v - true.v_n, log_so3(C @ np.swapaxes(true.C_nb, 1, 2)), true


def test_quiet_imu_navigates_exactly() -> None:
    dr, dv, phi, _ = navigated(imu.ImuTable(noise=QUIET), flight(60.0, 4.0)["a"], 60.0)
    assert max(np.max(np.abs(dr)), np.max(np.abs(dv)), np.max(np.abs(phi))) < 1e-4


def test_biases_grow_as_predicted() -> None:
    """Straight flight: accelerometer bias b gives b t^2 / 2, gyroscope bias e gives e t and g e t^3 / 6."""
    path, T = flight(20.0)["a"], 20.0
    dr, dv, _, true = navigated(imu.ImuTable(noise=QUIET, accel_bias_mps2=(0.01, -0.02, 0.005)), path, T)
    b_n = true.C_nb[0] @ np.array([0.01, -0.02, 0.005])
    np.testing.assert_allclose(dv[-1], b_n * T, rtol=0.01)
    np.testing.assert_allclose(dr[-1], b_n * T**2 / 2, rtol=0.01)
    dr, _, phi, true = navigated(imu.ImuTable(noise=QUIET, gyro_bias_rps=(1e-4, 0.0, 0.0)), path, T)
    e_n = true.C_nb[0] @ np.array([1e-4, 0.0, 0.0])
    np.testing.assert_allclose(phi[-1], e_n * T, atol=1e-5)
    np.testing.assert_allclose(dr[-1, :2], np.cross(e_n, [0.0, 0.0, 9.81])[:2] * T**3 / 6, rtol=0.02, atol=2e-3)


def test_imu_noise_has_the_stated_densities() -> None:
    path, T = flight(100.0)["b"], 100.0
    noise = QUIET.model_copy(update={"gyro_rps_rthz": 1e-3, "accel_mps2_rthz": 2e-3})
    clean, noisy = (sensed(imu.ImuTable(noise=n), path, T)[0] for n in (QUIET, noise))
    np.testing.assert_allclose((noisy.w_b - clean.w_b).std(axis=0), 1e-3 * np.sqrt(200.0), rtol=0.03)
    np.testing.assert_allclose((noisy.f_b - clean.f_b).std(axis=0), 2e-3 * np.sqrt(200.0), rtol=0.03)
    walking = QUIET.model_copy(update={"gyro_bias_walk_rps_rts": 1e-4})
    _, record = sensed(imu.ImuTable(noise=walking), path, T)
    np.testing.assert_allclose(np.diff(record.gyro_bias_rps, axis=0).std(axis=0), 1e-4 * np.sqrt(0.005), rtol=0.03)


BIASED = ImuNoiseTable(gyro_rps_rthz=1e-12, accel_mps2_rthz=1e-12, gyro_bias_deg_h=5.0, accel_bias_mg=2.0)


def test_gauss_markov_biases_have_their_size_and_correlation() -> None:
    """Spec common.md, section 4: steady standard deviation from the first sample, exp(-dt / tau) from one to the next."""
    T, tau = 2000.0, 5.0
    table = imu.ImuTable(
        rate_hz=20.0, noise=BIASED, gyro_gm_deg_h=3.0, gyro_gm_s=tau, accel_gm_mg=0.5, accel_gm_s=tau, accel_bias_mps2=(0, 0, 0)
    )
    _, record = sensed(table, flight(T)["b"], T)
    expected = (3.0 * np.pi / 180 / 3600, 0.5 * 9.80665e-3)
    effective = 3 * T / (2 * tau)  # independent samples
    for bias, sigma in zip((record.gyro_bias_rps, record.accel_bias_mps2), expected, strict=True):
        x = (bias - bias.mean(axis=0)) / sigma
        assert abs(np.mean(x * x) - 1) < 5 * np.sqrt(2 / effective)
        for lag_s in (1.0, 5.0):
            k = round(lag_s * 20)
            assert abs(np.mean(x[k:] * x[:-k]) - np.exp(-lag_s / tau)) < 5 / np.sqrt(effective)
    assert np.max(np.abs(record.accel_bias_mps2.mean(axis=0))) < 5 * expected[1] * np.sqrt(2 * tau / T)
    starts = np.array([gauss_markov(np.random.default_rng(k).normal(size=2), 0.3) for k in range(4000)])
    np.testing.assert_allclose(starts.var(axis=0), 1.0, atol=5 * np.sqrt(2 / 4000))
    np.testing.assert_allclose(np.mean(starts[:, 0] * starts[:, 1]), np.exp(-0.3), atol=5 / np.sqrt(4000))


def test_a_gauss_markov_bias_is_told_as_the_walk_of_its_driving_noise() -> None:
    told = imu.ImuTable(noise=BIASED, gyro_gm_deg_h=3.0, gyro_gm_s=200.0).told.noise
    np.testing.assert_allclose(told.gyro_bias_walk_rps_rts, np.sqrt(2 * (3.0 / 3600 * np.pi / 180) ** 2 / 200.0), rtol=1e-12)
    np.testing.assert_allclose(told.gyro_bias_rps, np.hypot(5.0, 3.0) / 3600 * np.pi / 180, rtol=1e-12)
    assert told.accel_bias_walk_mps2_rts == BIASED.noise.accel_bias_walk_mps2_rts
    walking = BIASED.model_copy(update={"gyro_bias_walk_deg_h_rts": 1.0})
    with pytest.raises(ValidationError, match=r"gyro_gm_deg_h and noise.gyro_bias_walk_deg_h_rts exclude each other"):
        imu.ImuTable(noise=walking, gyro_gm_deg_h=3.0)


def test_a_drawn_bias_is_told_with_its_gauss_markov_part() -> None:
    """Constant and varying part together where the start is drawn; as declared where it is given."""
    noise = ImuNoiseTable(gyro_bias_deg_h=3.0, accel_bias_mg=4.0)
    told = imu.ImuTable(noise=noise, gyro_gm_deg_h=4.0, accel_gm_mg=3.0).told.noise
    np.testing.assert_allclose((told.gyro_bias_rps, told.accel_bias_mps2), (np.deg2rad(5.0 / 3600), 5e-3 * 9.80665))
    given = imu.ImuTable(noise=noise, gyro_gm_deg_h=4.0, accel_gm_mg=3.0, accel_bias_mps2=(0.0, 0.0, 0.0)).told.noise
    assert given.accel_bias_mps2 == pytest.approx(4e-3 * 9.80665) and given.gyro_bias_rps == told.gyro_bias_rps
    still = imu.ImuTable(noise=noise).told
    assert still == noise


def test_scale_factors_multiply_the_motion() -> None:
    path = flight(10.0, 10.0)["a"]
    exact, _ = sensed(imu.ImuTable(noise=QUIET), path, 10.0)
    scaled, record = sensed(imu.ImuTable(noise=QUIET, gyro_scale_ppm=500, accel_scale_ppm=800), path, 10.0)
    assert np.all(record.gyro_scale != 0) and np.max(np.abs(record.accel_scale)) < 800e-6 * 5
    np.testing.assert_allclose(scaled.w_b, exact.w_b * (1 + record.gyro_scale), atol=1e-9)
    np.testing.assert_allclose(scaled.f_b, exact.f_b * (1 + record.accel_scale), atol=1e-9)


def test_imu_at_rest_feels_gravity_and_earth_rate() -> None:
    path = flight(5.0)["b"]
    stream, _ = sensed(imu.ImuTable(), path, 5.0, 0.0)
    true = path.at(stream.t_s)
    np.testing.assert_allclose(stream.f_b, -FRAME.gravity(true.r_n) @ true.C_nb[0], atol=1e-9)
    np.testing.assert_allclose(stream.w_b - FRAME.w_ie_n @ true.C_nb[0], 0.0, atol=1e-11)
    assert stream.t_s[0] == 0.0 and stream.t_s[-1] == 5.0 and stream.is_mean


TAGS = (
    TagTable(name="ta", vehicle="a", lever_b=(0.3, 1.0, -0.2)),
    TagTable(name="tb", vehicle="b", lever_b=(0.0, 0.5, 0.4)),
    TagTable(name="anchor", position_m=(100.0, 50.0, 2.0)),
)


def test_ranges_without_noise_are_distances_between_tags() -> None:
    paths = flight(30.0, 5.0)
    model, _ = ranging.simulate(ranging.RangeTable(tags=TAGS, bias_m=1.0, nlos_probability=0.5), paths, 30.0, STREAMS, 0.0)
    s = model.stream
    assert sorted({(int(i), int(j)) for i, j in zip(s.tag_a, s.tag_b, strict=True)}) == [(0, 1), (0, 2), (1, 2)]
    for i, (a, b) in enumerate(zip(s.tag_a[:60], s.tag_b[:60], strict=True)):
        ends = []
        for tag in (TAGS[a], TAGS[b]):
            motion = paths[tag.vehicle].at(s.t_s[i : i + 1]) if tag.vehicle else None
            ends.append(motion.r_n[0] + motion.C_nb[0] @ tag.lever_b if motion else np.array(tag.position_m))
        np.testing.assert_allclose(s.range_m[i], np.linalg.norm(ends[0] - ends[1]), atol=1e-9)


def test_range_errors_have_the_stated_statistics() -> None:
    table = ranging.RangeTable(
        tags=TAGS[:2], rate_hz=50.0, sigma_m=0.05, bias_m=0.2, scale_ppm=100.0, nlos_probability=0.2, nlos_mean_m=0.8, dropout=0.3
    )
    model, record = ranging.simulate(table, flight(200.0, 3.0), 200.0, STREAMS, 1.0)
    n, blocked = len(model.stream.t_s), record.nlos_m > 0
    assert abs(n / 10_001 - 0.7) < 4 * np.sqrt(0.21 / 10_001)
    assert abs(blocked.mean() - 0.2) < 4 * np.sqrt(0.16 / n)
    np.testing.assert_allclose(record.nlos_m[blocked].mean(), 0.8, rtol=4 / np.sqrt(blocked.sum()))
    rest = model.stream.range_m - record.true_m * (1 + 1e-4) - record.nlos_m - 0.2
    np.testing.assert_allclose((rest.mean(), rest.std()), (0.0, 0.05), atol=4 * 0.05 / np.sqrt(n))


def test_fixes_and_heights_are_at_their_levers() -> None:
    path = flight(20.0, 8.0)["a"]
    positions = fixes.positions(fixes.PositionTable(lever_b=(1.0, 0.0, 0.5), offset_s=0.25), path, 20.0, STREAMS, 0.0)
    heights = fixes.heights(fixes.HeightTable(lever_b=(1.0, 0.0, 0.5), rate_hz=4.0), path, 20.0, STREAMS, 0.0)
    motion = path.at(positions.t_s)
    np.testing.assert_allclose(positions.r_n, motion.r_n + motion.C_nb @ [1.0, 0.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(heights.up_m[1::4], positions.r_n[:, 2], atol=1e-9)
    noisy = fixes.positions(fixes.PositionTable(rate_hz=100.0, sigma_m=(1.0, 2.0, 3.0)), path, 20.0, STREAMS, 1.0)
    np.testing.assert_allclose((noisy.r_n - path.at(noisy.t_s).r_n).std(axis=0), (1.0, 2.0, 3.0), rtol=0.08)


def test_wrong_tags_are_named() -> None:
    with pytest.raises(InputError, match="no tag tc; did you mean"):
        ranging.pairs_of(ranging.RangeTable(tags=TAGS, pairs=(("ta", "tc"),)))
    with pytest.raises(InputError, match="all on one vehicle"):
        ranging.pairs_of(ranging.RangeTable(tags=(TAGS[0], TAGS[0].model_copy(update={"name": "x"}))))
