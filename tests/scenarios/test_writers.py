"""Solutions on disk and in other programs' formats."""

from __future__ import annotations

import dataclasses
import errno
import os
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

from factorgraph.attitude import matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.solution import ParameterEstimate, Solution
from scenarios import solutions, writers
from scenarios.flights.rtklib_pos import read_pos
from tests.scenarios.solution_example import example_solution, with_base


@pytest.fixture(scope="module")
def solution() -> Solution:
    return with_base(example_solution(n=40))


def _assert_same(a: Any, b: Any, path: str = "solution") -> None:
    b = b.item() if isinstance(b, np.generic) else b
    assert type(a) is type(b), path
    if dataclasses.is_dataclass(a):
        for f in dataclasses.fields(a):
            _assert_same(getattr(a, f.name), getattr(b, f.name), f"{path}.{f.name}")
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, path
        np.testing.assert_array_equal(a, b, err_msg=path)
    elif isinstance(a, tuple | list):
        assert len(a) == len(b), path
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            _assert_same(x, y, f"{path}[{i}]")
    elif isinstance(a, dict):
        assert list(a) == list(b), path
        for key in a:
            _assert_same(a[key], b[key], f"{path}.{key}")
    else:
        assert a == b or (a != a and b != b), path


def test_a_solution_survives_the_disk_unchanged(solution: Solution, tmp_path: Path) -> None:
    odd = dataclasses.replace(
        solution,
        configuration={"x": [1, 2.5, None, True, {"y": float("inf")}], "τ": "m/s²"},
        diagnostics=dataclasses.replace(
            solution.diagnostics, parameters=(ParameterEstimate("bias", "m", 0.1, float("nan"), 0.0, 1.0),), warnings=("a", "b")
        ),
    )
    solutions.save(odd, tmp_path / "s")
    _assert_same(solutions.load(tmp_path / "s"), odd)
    solutions.save(solution, tmp_path / "s")  # replaces
    _assert_same(solutions.load(tmp_path / "s"), solution)
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


def test_a_solution_without_pairs_and_residuals(tmp_path: Path) -> None:
    bare = dataclasses.replace(example_solution(n=1, with_truth=False), pairs=())
    solutions.save(bare, tmp_path / "s")
    _assert_same(solutions.load(tmp_path / "s"), bare)


def test_a_full_disk_keeps_what_was_there(solution: Solution, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "s"
    solutions.save(solution, folder)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(InputError, match=r"cannot write .*s: No space left on device"):
        solutions.save(dataclasses.replace(solution, name="other"), folder)
    monkeypatch.undo()
    assert solutions.load(folder).name == solution.name
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


def test_an_interrupt_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("before")

    def interrupted(part: Path) -> None:
        part.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        solutions.replace_with(path, interrupted)
    assert path.read_text() == "before" and [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_place_that_cannot_be_written(solution: Solution, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        solutions.save(solution, tmp_path / "file" / "s")


def test_what_is_no_solution(solution: Solution, tmp_path: Path) -> None:
    folder = tmp_path / "s"
    with pytest.raises(InputError, match="No such file"):
        solutions.load(folder)
    solutions.save(solution, folder)
    text = (folder / solutions.TEXT).read_text()
    for broken, telling in (
        ("{}", "not a solution"),
        ("{", "damaged"),
        (text.replace('"version": 1', '"version": 99'), "version 99"),
        (text.replace('"vehicles.0.r_n"', '"vehicles.9.r_n"'), "damaged"),
        (text.replace('"status": "CONVERGED"', '"status": "DONE"'), "damaged"),
    ):
        (folder / solutions.TEXT).write_text(broken)
        with pytest.raises(InputError, match=telling):
            solutions.load(folder)
    (folder / solutions.TEXT).write_text(text)
    (folder / solutions.ARRAYS).write_bytes(b"junk")
    with pytest.raises(InputError, match="damaged"):
        solutions.load(folder)


def test_what_cannot_be_saved_is_named(solution: Solution, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"configuration\.path is a PosixPath|configuration\.path is a WindowsPath"):
        solutions.save(dataclasses.replace(solution, configuration={"path": tmp_path}), tmp_path / "s")
    assert not list(tmp_path.iterdir())


def test_every_format_is_written(solution: Solution, tmp_path: Path) -> None:
    written = writers.write_all(solution, tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(p.name for p in written)
    assert {p.suffix for p in written} == {".parquet", ".csv", ".pos", ".tum", ".kml"}


def test_tables_hold_the_numbers(solution: Solution, tmp_path: Path) -> None:
    rover, pair = solution.vehicle("rover"), solution.pairs[0]
    for name, table in writers.tables(solution).items():
        writers.write_parquet(table, tmp_path / f"{name}.parquet")
        writers.write_csv(table, tmp_path / f"{name}.csv")
        assert (
            pq.read_table(tmp_path / f"{name}.parquet").num_rows
            == pacsv.read_csv(tmp_path / f"{name}.csv").num_rows
            == table.num_rows
        )
    vehicle = pacsv.read_csv(tmp_path / "vehicle-rover.csv")
    np.testing.assert_array_equal(np.column_stack([vehicle[f"{x}_m"].to_numpy() for x in ("east", "north", "up")]), rover.r_n)
    np.testing.assert_allclose(vehicle["sigma_up_m"].to_numpy(), np.sqrt(rover.P[:, 2, 2]))
    assert vehicle["gps_week"][0].as_py() == solution.t0.week
    assert pacsv.read_csv(tmp_path / "vehicle-base.csv")["heading_deg"].null_count == len(rover.t_s)
    frame = pq.read_table(tmp_path / "pair-base-rover.parquet")
    assert set(frame["fix"].to_pylist()) <= {"none", "float", "partial", "fixed"}
    np.testing.assert_array_equal(frame["up_m"].to_numpy(), pair.baseline_enu[:, 2])
    residuals = pq.read_table(tmp_path / "residuals.parquet")
    assert residuals["kind"][0].as_py() == solution.residuals.kind[solution.residuals.kind_index[0]]


def test_pos_reads_back(solution: Solution, tmp_path: Path) -> None:
    rover, pair = solution.vehicle("rover"), solution.pairs[0]
    writers.write_pos(solution, "rover", tmp_path / "r.pos")
    back = read_pos(tmp_path / "r.pos")
    ecef = back.ecef()
    assert ecef is not None
    np.testing.assert_allclose(solution.frame.from_ecef(ecef), rover.r_n, atol=2e-4)
    np.testing.assert_allclose(back.times.since(solution.t0), rover.t_s, atol=1e-3)
    np.testing.assert_allclose(np.sqrt(back.cov[:, 2, 2]), np.sqrt(rover.P[:, 2, 2]), atol=1e-4)
    assert set(back.quality.tolist()) <= {1, 2, 4} and back.n_sat.tolist() == pair.n_sat.tolist()
    writers.write_baseline_pos(solution, pair, tmp_path / "b.pos")
    baseline = read_pos(tmp_path / "b.pos")
    np.testing.assert_allclose(baseline.position, pair.baseline_enu, atol=1e-4)
    assert baseline.kind == "enu" and baseline.reference_ecef is not None
    np.testing.assert_allclose(baseline.reference_ecef, solution.frame.to_ecef(solution.vehicle("base").r_n[0]), atol=1e-3)


def test_a_moving_pair_has_no_reference_position(tmp_path: Path) -> None:
    moving = example_solution(n=5)
    writers.write_baseline_pos(moving, moving.pairs[0], tmp_path / "b.pos")
    assert "ref pos" not in (tmp_path / "b.pos").read_text()
    writers.write_pos(moving, "rover", tmp_path / "r.pos")
    assert set(read_pos(tmp_path / "r.pos").quality.tolist()) == {5}


def test_milliseconds_round_across_the_minute(tmp_path: Path) -> None:
    solution = example_solution(n=2)
    late = dataclasses.replace(solution, t0=solution.t0 + 59.9996)
    writers.write_pos(late, "rover", tmp_path / "r.pos")
    rows = [line for line in (tmp_path / "r.pos").read_text().splitlines() if not line.startswith("%")]
    assert rows[0].startswith("2024/05/14 12:01:00.000")


def test_tum(solution: Solution, tmp_path: Path) -> None:
    rover, base = solution.vehicle("rover"), solution.vehicle("base")
    writers.write_tum(rover.t_s, rover.r_n, rover.q_nb, tmp_path / "r.tum")
    rows = np.loadtxt(tmp_path / "r.tum")
    np.testing.assert_allclose(rows[:, :4], np.column_stack([rover.t_s, rover.r_n]), atol=1e-8)
    np.testing.assert_allclose(matrix_from_quat(rows[:, [7, 4, 5, 6]]), matrix_from_quat(rover.q_nb), atol=1e-7)
    writers.write_tum(base.t_s, base.r_n, base.q_nb, tmp_path / "b.tum")
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "b.tum")[:, 4:], np.tile([0, 0, 0, 1], (len(base.t_s), 1)))


def test_kml(solution: Solution, tmp_path: Path) -> None:
    writers.write_kml(solution, tmp_path / "p.kml")
    root = ElementTree.parse(tmp_path / "p.kml").getroot()
    space = "{http://www.opengis.net/kml/2.2}"
    line = root.find(f".//{space}LineString/{space}coordinates")
    point = root.find(f".//{space}Point/{space}coordinates")
    assert line is not None and point is not None and line.text is not None and point.text is not None
    lon, lat, _ = (float(x) for x in line.text.split()[0].split(","))
    assert lat == pytest.approx(47.07, abs=0.01) and lon == pytest.approx(15.44, abs=0.01)


def test_names_fit_file_systems() -> None:
    assert writers.file_name("uav 1/left:a") == "uav_1_left_a" and writers.file_name("..") == "_"
