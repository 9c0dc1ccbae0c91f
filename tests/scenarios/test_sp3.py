"""SP3 orbits against the orbits that were written into the file, against cssrlib, at gaps and ends, and through a flight."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.geodesy import C_MPS
from factorgraph.gpstime import GpsTime
from factorgraph.types import Array, IntArray
from scenarios.flights import _orbits as orbits
from scenarios.flights.navigation import Navigation, builtin_constellation, read_navigation
from scenarios.flights.rinex_writer import write_navigation
from scenarios.flights.sp3 import read_sp3

T0 = GpsTime.from_calendar(2024, 6, 5, 0, 0, 0.0)
STEP_S = 900.0
NAMES = ("G05", "G17", "E11", "C30", "J02")


class Orbits:
    """One message per satellite, whatever the time: smooth over hours. Its clock without relativity is what SP3 holds."""

    def __init__(self) -> None:
        self.navigation = builtin_constellation().shifted_to(T0)
        self.names = tuple(name for name in NAMES if name in self.navigation.kepler.satellites)
        assert len(self.names) >= 4

    def at(self, name: str, t_s: Array) -> orbits.OrbitClock:
        k = self.navigation.kepler
        i = k.satellites.index(name)
        t = t_s + (T0 - self.navigation.t_ref)
        p = np.tile(k.data[i][:, None], (1, len(t)))
        return orbits.kepler_states(p, np.full(len(t), name[0]), np.zeros(len(t), bool), t - k.toe_s[i], t - k.toc_s[i])

    def clock_s(self, name: str, t_s: Array) -> Array:
        k = self.navigation.kepler
        i = k.satellites.index(name)
        t = t_s + (T0 - self.navigation.t_ref)
        return orbits.kepler_clock_s(np.tile(k.data[i][:, None], (1, len(t))), t - k.toc_s[i])


def write(
    path: Path, known: Orbits, epochs: IntArray, version: str = "d", without: tuple[str, int] = ("", 0), end: bool = True
) -> Path:
    """An SP3 file of the orbits at whole steps after T0; one satellite may miss its position at one epoch."""
    start = (T0 + float(epochs[0]) * STEP_S).calendar()
    stamp = f"{start:%Y} {start.month:2d} {start.day:2d} {start.hour:2d} {start.minute:2d} {0:11.8f}"
    lines = [f"#{version}P{stamp} {len(epochs):7d} ORBIT IGS20 HLM TEST"]
    lines.append(f"## {T0.week:4d} {T0.sow:15.8f} {STEP_S:14.8f} 60466 0.0000000000000")
    lines.append("+  " + f"{len(known.names):3d}   " + "".join(known.names) + "  0" * (17 - len(known.names)))
    lines += ["++       " + "  0" * 17, "%c M  cc GPS ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc"]
    lines += ["%c cc cc ccc ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc"]
    lines += ["%f  1.2500000  1.025000000  0.00000000000  0.000000000000000"]
    lines += ["%f  0.0000000  0.000000000  0.00000000000  0.000000000000000"]
    lines += ["%i    0    0    0    0      0      0      0      0         0"] * 2 + ["/* written by a test"] * 4
    for epoch in epochs:
        when = (T0 + float(epoch) * STEP_S).calendar()
        lines.append(f"*  {when:%Y} {when.month:2d} {when.day:2d} {when.hour:2d} {when.minute:2d} {0:11.8f}")
        for name in known.names:
            t = np.array([float(epoch) * STEP_S])
            pos = known.at(name, t).pos[0] / 1e3 * (0.0 if (name, epoch) == without else 1.0)
            lines.append(f"P{name}" + "".join(f"{x:14.6f}" for x in pos) + f"{known.clock_s(name, t)[0] * 1e6:14.6f}")
    path.write_text("\n".join([*lines, *(["EOF"] if end else [])]) + "\n", encoding="ascii")
    return path


def states(navigation: Navigation, name: str, t_s: Array) -> tuple[Array, Array, Array, Array]:
    got = navigation.states_at((name,), np.zeros(len(t_s), np.int64), T0, t_s)
    return got.pos_ecef, got.vel_ecef, got.clock_m, got.clock_mps


@pytest.mark.parametrize("version", ["c", "d"])
def test_orbits_between_nodes(tmp_path: Path, version: str) -> None:
    """15 min apart: millimetres in the middle of the file; clocks and velocities follow."""
    known = Orbits()
    navigation = read_navigation([write(tmp_path / "x.sp3", known, np.arange(0, 33), version)])
    t = np.random.default_rng(1).uniform(6 * STEP_S, 26 * STEP_S, 200)
    for name in known.names:
        true = known.at(name, t)
        pos, vel, clock, rate = states(navigation, name, t)
        assert np.abs(pos - true.pos).max() < 2e-3, name
        assert np.abs(vel - true.vel).max() < 1e-5
        assert np.abs(clock - true.clock_s * C_MPS).max() < 2e-3
        assert np.abs(rate - true.rate * C_MPS).max() < 1e-5


def test_nothing_beyond_the_ends_nor_in_a_gap(tmp_path: Path) -> None:
    known = Orbits()
    name = known.names[0]
    navigation = read_navigation([write(tmp_path / "x.sp3", known, np.arange(0, 40), without=(name, 20))])
    t = np.array([-0.001, 0.0, 19.0, 19.5, 20.0, 20.5, 21.0, 39.0, 39.001]) * STEP_S
    got = np.isfinite(states(navigation, name, t)[0][:, 0])
    np.testing.assert_array_equal(got, [False, True, True, False, False, False, True, True, False])
    assert np.all(np.isfinite(states(navigation, known.names[1], t[1:-1])[0]))
    at_ends = states(navigation, name, np.array([30.0, 39 * STEP_S - 30.0]))[0]
    assert np.abs(at_ends - known.at(name, np.array([30.0, 39 * STEP_S - 30.0])).pos).max() < 0.5
    assert navigation.report.dropped["position missing"] == 1


def test_days_that_follow_are_one_and_a_cut_file_is_noted(tmp_path: Path) -> None:
    known = Orbits()
    first = write(tmp_path / "a.sp3", known, np.arange(0, 12))
    second = write(tmp_path / "b.sp3", known, np.arange(11, 24), end=False)
    orbits_, _, report = read_sp3([first, second])
    assert np.all(orbits_.run_end - orbits_.run_first == 24) and report.dropped == {"no EOF: the file ends early": 1}
    navigation = read_navigation([first, second])
    t = np.linspace(6, 17, 100) * STEP_S
    assert np.abs(states(navigation, known.names[0], t)[0] - known.at(known.names[0], t).pos).max() < 2e-3


def test_messages_beside_sp3_give_group_delays_and_what_it_lacks(tmp_path: Path) -> None:
    known = Orbits()
    file = write(tmp_path / "x.sp3", known, np.arange(-12, 13))
    write_navigation(tmp_path / "x.rnx", known.navigation)
    both, alone = read_navigation([tmp_path / "x.rnx", file]), read_navigation([file])
    t = np.array([600.0])
    name = known.names[0]
    np.testing.assert_allclose(states(both, name, t)[0], states(alone, name, t)[0], atol=1e-6)
    assert both.klobuchar is not None and any("group delays" in note for note in alone.report.notes)
    missing = next(name for name in both.satellites if name not in known.names)
    assert np.all(np.isfinite(states(both, missing, t)[0])) and not np.any(np.isfinite(states(alone, missing, t)[0]))
    record = both.states_at((name,), np.zeros(1, np.int64), T0, t).record
    assert record[0] >= 0 and both.group_delay_m(record, ("G1C",), np.zeros(1, np.int64)).shape == (1,)


def test_transmission_times_use_the_files_clocks(tmp_path: Path) -> None:
    known = Orbits()
    navigation = read_navigation([write(tmp_path / "x.sp3", known, np.arange(0, 25))])
    name, t = known.names[1], np.array([9000.0, 9001.5])
    true = known.at(name, t)
    got = navigation.satellite_states((name,), np.zeros(2, np.int64), T0, t + known.clock_s(name, t))
    np.testing.assert_allclose(got.pos_ecef, true.pos, atol=2e-3)


def test_cssrlib_interpolates_alike(tmp_path: Path) -> None:
    """Another degree and no relativity there: centimetres."""
    peph_module = pytest.importorskip("cssrlib.peph")
    gnss = pytest.importorskip("cssrlib.gnss")
    known = Orbits()
    file = write(tmp_path / "x.sp3", known, np.arange(0, 33))
    nav = peph_module.peph().parse_sp3(str(file), gnss.Nav())
    reader = peph_module.peph()
    ours = read_navigation([file])
    for name in known.names[:3]:
        for t in (9_123.0, 12_000.0):
            when = gnss.gpst2time(T0.week, T0.sow + t)
            rs, _, _ = reader.peph2pos(when, gnss.id2sat(name), nav)
            np.testing.assert_allclose(states(ours, name, np.array([t]))[0][0], rs[:3], atol=0.02)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace("#dP", "#aP"), "SP3-a is not supported"),
        (lambda text: text.replace("cc GPS ccc", "cc XYZ ccc"), "unknown time system 'XYZ'"),
        (lambda text: text.replace("*  2024  6  5  0 15", "*  2024  6 xx  0 15"), "is not an epoch"),
        (lambda text: text[: text.index("*  ")], "no usable position"),
    ],
)
def test_faults_are_named(tmp_path: Path, change: object, words: str) -> None:
    file = write(tmp_path / "x.sp3", Orbits(), np.arange(0, 12))
    file.write_text(change(file.read_text()))  # type: ignore[operator]
    with pytest.raises(InputError, match=words):
        read_navigation([file])
