"""Columns of delimited text and of MATLAB files, and what their time columns count.

Cells that are not numbers become NaN and are counted; rows with a wrong number of cells are dropped and counted.
The number of columns is the header's, without one the commonest among the first rows.
"""

from __future__ import annotations

import csv
import difflib
import gzip
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv

from factorgraph.errors import InputError
from factorgraph.gpstime import GPS_EPOCH, WEEK_S, GpsTime, leap_seconds
from factorgraph.types import Array, BoolArray
from scenarios.flights.schema import TextOptions, TimeColumn, nearest_hint

UNIT_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
UNIX_TO_GPS_S = (GPS_EPOCH - UNIX_EPOCH).total_seconds()
NULLS = ["", "nan", "NaN", "NAN", "-nan", "NA", "N/A", "null", "NULL", "None", "none"]
FAR_S, FAR_SPANS = 600.0, 10.0  # a single time stamp further than both from the span of all others is wrong
PROBE_LINES = 200  # lines looked at for the number of columns
PROBE_BYTES = 1 << 16  # looked at for what is not text
MAX_NOT_TEXT = 0.05  # share of bytes: a logger that loses power leaves a few
NOT_TEXT = re.compile(rb"[\x00-\x08\x0e-\x1f]")

Names = np.ndarray[tuple[int], np.dtype[np.str_]]


@dataclass(frozen=True, slots=True)
class RawTable:
    """Columns as they stand in a file: numbers, and text where it was asked for."""

    path: Path
    n_rows: int  # of the file, before dropping
    numbers: dict[str | int, Array]
    texts: dict[str | int, Names] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)

    @property
    def n_rows_kept(self) -> int:
        return self.n_rows - sum(self.dropped.values())

    def stack(self, columns: Sequence[str | int]) -> Array:
        """Columns side by side (n, k)."""
        return np.column_stack([self.numbers[c] for c in columns])


@dataclass(frozen=True, slots=True)
class Times:
    """Times in a file: seconds since `ref`, or of the flight's own clock when `ref` is None."""

    t_s: Array
    ref: GpsTime | None = None
    is_sow: bool = False  # seconds of week: the week follows from the flight's t0

    def since(self, t0: GpsTime) -> Array:
        """Seconds since t0 (n,)."""
        if self.ref is not None:
            return self.t_s + (self.ref - t0)
        if not self.is_sow:
            return self.t_s
        t = self.t_s - t0.sow
        return np.asarray(t - WEEK_S * np.round(t / WEEK_S))


def require_file(path: Path) -> Path:
    """The path itself if it is a file. Raises InputError with the nearest name in its folder."""
    if path.is_file():
        return path
    if path.is_dir():
        raise InputError(f"{path}: is a folder, a file is needed")
    if path.is_symlink():
        raise InputError(f"{path}: a link to {path.readlink()}, which is not there")
    if not path.parent.is_dir():
        raise InputError(f"{path}: no such file; its folder does not exist")
    near = difflib.get_close_matches(path.name, [p.name for p in path.parent.iterdir()], n=1)
    raise InputError(f"{path}: no such file" + (f"; did you mean {near[0]}?" if near else ""))


def read_bytes(path: Path) -> bytes:
    """Content of a file, unpacked when it is gzip. Raises InputError when it is missing, empty or unreadable."""
    try:
        data = require_file(path).read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
    except (OSError, EOFError) as error:
        raise InputError(f"{path}: {getattr(error, 'strerror', None) or error}") from error
    if not data.strip():
        raise InputError(f"{path}: the file is empty")
    return data


def read_columns(
    path: Path, options: TextOptions, kind: str, numbers: Iterable[str | int], texts: Iterable[str | int] = ()
) -> RawTable:
    """Read columns of a file; `kind` is "csv" or "mat".

    Raises InputError naming file and column for a missing file or column, and for a file whose rows do not have the
    declared number of cells.
    """
    wanted, wanted_text = list(dict.fromkeys(numbers)), list(dict.fromkeys(texts))
    if kind == "mat":
        return _read_mat(path, options.variable, wanted, wanted_text)
    return _read_csv(path, options, wanted, wanted_text)


def _read_csv(path: Path, options: TextOptions, numbers: list[str | int], texts: list[str | int]) -> RawTable:
    data, delimiter, first_line = _plain_text(_text(path), options)
    names, n_columns = _layout(data, delimiter, options, path)
    where = {column: _index(column, names, n_columns, path) for column in (*numbers, *texts)}
    invalid: list[int] = []

    def on_invalid(row: pacsv.InvalidRow) -> str:
        invalid.append(row.actual_columns)
        return "skip"

    keys = [f"c{i}" for i in range(n_columns)]
    types = {keys[where[c]]: pa.float64() for c in numbers} | {keys[where[c]]: pa.string() for c in texts}
    convert = pacsv.ConvertOptions(column_types=types, include_columns=list(types), null_values=NULLS, strings_can_be_null=False)
    read = pacsv.ReadOptions(column_names=keys, skip_rows=int(options.header))
    parse = pacsv.ParseOptions(delimiter=delimiter, invalid_row_handler=on_invalid)
    try:
        table = pacsv.read_csv(pa.py_buffer(data), read, parse, convert)
    except pa.ArrowInvalid:
        # some cell is not a number: read the cells as text and convert one by one
        invalid.clear()
        convert.column_types = dict.fromkeys(types, pa.string())
        try:
            table = pacsv.read_csv(pa.py_buffer(data), read, parse, convert)
        except pa.ArrowInvalid as error:
            raise InputError(f"{path}: {str(error).splitlines()[0]}") from error
        table = _numbers_from_text(table, [keys[where[c]] for c in numbers])
    n_rows = table.num_rows + len(invalid)
    if len(invalid) > 0.5 * n_rows:
        common = Counter(invalid).most_common(1)[0][0]
        raise InputError(
            f"{path}, line {first_line}: {n_columns} columns, but most rows have {common}; check delimiter, header and skip_rows"
        )
    if table.num_rows == 0:
        raise InputError(f"{path}: no rows after the header")
    dropped = {"wrong number of cells": len(invalid)} if invalid else {}
    values = {c: _as_numpy(table[keys[where[c]]]) for c in numbers}
    return RawTable(path, n_rows, values, {c: _as_text(table[keys[where[c]]]) for c in texts}, dropped)


def _text(path: Path) -> bytes:
    """Content of a text file as UTF-8. Raises InputError where it is not text."""
    data = read_bytes(path)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: UTF-16 text; save it as UTF-8")
    head = data[:PROBE_BYTES]
    if len(NOT_TEXT.findall(head)) > MAX_NOT_TEXT * len(head):
        raise InputError(f"{path}: not a text file, where columns of numbers are needed")
    try:
        data.decode()
    except UnicodeDecodeError:
        return data.decode("utf-8", "replace").encode()
    return data


def _plain_text(data: bytes, options: TextOptions) -> tuple[bytes, str, int]:
    """Text without byte-order mark, skipped lines and comments, one-character delimiter, line number of its start."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    if options.skip_rows:
        data = b"\n".join(data.split(b"\n")[options.skip_rows :])
    if options.comment:
        mark = options.comment.encode()
        data = b"\n".join(line for line in data.split(b"\n") if not line.lstrip().startswith(mark))
    if options.only:
        mark = options.only.encode()
        data = b"\n".join(line for line in data.split(b"\n") if line.startswith(mark))
    if options.delimiter != "whitespace":
        return data, options.delimiter, options.skip_rows + 1
    return re.sub(rb"(?m)^ +| +$", b"", re.sub(rb"[ \t\r]+", b" ", data)), " ", options.skip_rows + 1


def _layout(data: bytes, delimiter: str, options: TextOptions, path: Path) -> tuple[list[str], int]:
    """Column names (empty without a header) and number of columns."""
    head = data[:PROBE_BYTES].decode("utf-8", "replace").splitlines()[:PROBE_LINES]
    if len(delimiter) != 1:
        raise InputError(f'{path}: delimiter {delimiter!r} must be one character or "whitespace"')
    rows = [row for row in csv.reader(head, delimiter=delimiter) if row]
    if not rows:
        raise InputError(f"{path}: no rows after skip_rows and comments")
    if options.header:
        names = [name.strip() for name in rows[0]]
        return names, len(names)
    return [], Counter(len(row) for row in rows).most_common(1)[0][0]


def _index(column: str | int, names: list[str], n_columns: int, path: Path) -> int:
    if isinstance(column, int):
        if column >= n_columns:
            raise InputError(f"{path}: no column {column}; there are {n_columns}, counted from 0")
        return column
    if column in names:
        return names.index(column)
    if not names:
        raise InputError(f"{path}: column {column} is named, but the file is declared without a header; use a number from 0")
    raise InputError(f"{path}: no column {column}{nearest_hint(column, names)}")


def _numbers_from_text(table: pa.Table, keys: list[str]) -> pa.Table:
    for key in keys:
        cells = [_number(cell) for cell in table[key].to_pylist()]
        table = table.set_column(table.schema.get_field_index(key), key, pa.array(cells, pa.float64()))
    return table


def _number(cell: str | None) -> float | None:
    try:
        return float(cell or "")
    except ValueError:
        return None


def _as_numpy(column: pa.ChunkedArray) -> Array:
    values = np.array(pc.fill_null(column, np.nan).to_numpy(), float)
    values[np.isinf(values)] = np.nan
    return values


def _as_text(column: pa.ChunkedArray) -> Names:
    return np.array([str(cell or "").strip() for cell in column.to_pylist()])


def _read_mat(path: Path, variable: str, numbers: list[str | int], texts: list[str | int]) -> RawTable:
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(require_file(path))
    except (MatReadError, NotImplementedError, ValueError, OSError) as error:
        raise InputError(f"{path}: not a readable MATLAB file (versions up to 7 are): {error}") from error
    known = sorted(name for name in content if not name.startswith("__"))
    if variable not in known:
        raise InputError(f"{path}: no variable {variable or '(none named)'}{nearest_hint(variable, known)}")
    values = np.asarray(content[variable])
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise InputError(f"{path}: variable {variable} is not a matrix of numbers")
    for column in (*numbers, *texts):
        if isinstance(column, str):
            raise InputError(f"{path}: column {column} of a MATLAB matrix is given by its number from 0")
        _index(column, [], values.shape[1], path)
    matrix = values.astype(float)
    return RawTable(
        path,
        len(matrix),
        {c: matrix[:, int(c)].copy() for c in numbers},
        {c: np.array([f"{cell:.17g}" for cell in matrix[:, int(c)]]) for c in texts},
    )


def read_times(table: RawTable, time: TimeColumn) -> Times:
    """Interpret the time column; seconds are counted from its first whole second where it counts from a far epoch.

    Raises InputError for calendar times that cannot be read.
    """
    if time.epoch in ("iso-gpst", "iso-utc"):
        return _calendar_times(table, time)
    cells = table.numbers[time.column] * time.scale
    if time.epoch in ("flight", "sow"):
        return Times(cells * UNIT_S[time.unit] + time.offset_s, None, time.epoch == "sow")
    finite = cells[np.isfinite(cells)]
    start = float(np.floor(finite[0] * UNIT_S[time.unit])) if finite.size else 0.0
    t_s = (cells - start / UNIT_S[time.unit]) * UNIT_S[time.unit] + time.offset_s
    if time.epoch == "gps":
        return Times(t_s, GpsTime(0, start))
    leap = leap_seconds(_unix(start, table.path)) if time.epoch == "unix" else 0
    return Times(t_s, GpsTime(0, start - UNIX_TO_GPS_S + leap))


def _unix(seconds: float, path: Path) -> datetime:
    try:
        return datetime.fromtimestamp(seconds, UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise InputError(f"{path}: time {seconds:.6g} s is no date since 1970; is the unit of the time column right?") from error


def _calendar_times(table: RawTable, time: TimeColumn) -> Times:
    texts = table.texts[time.column]
    instants: list[datetime | None] = [_calendar(text) for text in texts]
    known = [t for t in instants if t is not None]
    if not known:
        raise InputError(f'{table.path}: times like "{texts[0]}" are not calendar dates (2021-09-22T06:30:00.5)')
    start = known[0].replace(microsecond=0)
    ref = GpsTime.from_utc(start) if time.epoch == "iso-utc" else GpsTime.from_utc(start) + -float(leap_seconds(start))
    t_s = np.array([np.nan if t is None else (t - start).total_seconds() for t in instants])
    return Times(t_s + time.offset_s, ref)


def _calendar(text: str) -> datetime | None:
    try:
        parsed = datetime.fromisoformat(text.replace("/", "-"))
    except ValueError:
        return None
    return parsed.replace(tzinfo=UTC) if parsed.tzinfo is None else parsed.astimezone(UTC)


def time_columns(time: TimeColumn) -> tuple[list[str | int], list[str | int]]:
    """The time column as (numbers, texts) to ask `read_columns` for."""
    return ([], [time.column]) if time.epoch.startswith("iso") else ([time.column], [])


def ordered(t_s: Array, values: Array, source: str, distinct: bool = True) -> tuple[BoolArray, dict[str, int]]:
    """Rows to keep, and what is dropped: NaN rows, then times that do not exceed an earlier one.

    t_s (n,), values (n, k). `distinct`: equal times are dropped too. Raises InputError when nothing is left, or when
    more than half of the rows run backward.
    """
    finite = np.isfinite(t_s) & np.isfinite(values).all(axis=1)
    keep = finite.copy()
    t = t_s[finite]
    spike = spikes(t)
    latest = np.maximum.accumulate(np.concatenate([[-np.inf], np.where(spike, -np.inf, t)[:-1]])) if t.size else t
    repeated = (t == latest) & ~spike if distinct else np.zeros(len(t), bool)
    backward = (t < latest) | spike
    keep[finite] = ~(repeated | backward)
    n_repeated, n_backward = int(repeated.sum()), int(backward.sum())
    if n_repeated + n_backward > 0.5 * len(t):
        raise InputError(
            f"{source}: {n_backward} of {len(t)} time stamps run backward and {n_repeated} repeat; "
            "check the time column, its unit and epoch"
        )
    if not keep.any():
        raise InputError(f"{source}: no usable row; {int(np.sum(~finite))} of {len(t_s)} have empty or non-numeric cells")
    counts = {
        "with empty or non-numeric cells": int(np.sum(~finite)),
        "with a repeated time stamp": n_repeated,
        "with a backward time stamp": n_backward,
    }
    return keep, {reason: n for reason, n in counts.items() if n}


def spikes(t: Array) -> BoolArray:
    """Single time stamps that are wrong, not those after them.

    Stamps ahead of a successor that fits their predecessor, and a first or last one far from all the rest.
    """
    spike = np.zeros(len(t), bool)
    if len(t) > 2:
        spike[1:-1] = (t[1:-1] > t[2:]) & (t[:-2] <= t[2:])
        spike[0] = (t[0] > t[1] and t[0] > t[2]) or t[1] - t[0] > max(FAR_S, FAR_SPANS * (t[-1] - t[1]))
        spike[-1] = not spike[-2] and t[-1] - t[-2] > max(FAR_S, FAR_SPANS * (t[-2] - t[0]))
    return spike
