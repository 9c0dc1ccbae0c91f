"""RINEX files as bytes: opening (plain, gzip, Unix compress, Hatanaka), headers, numbers and dates.

A header line is 60 columns of content and 20 of label. Errors name the file and the line.
"""

from __future__ import annotations

import gzip
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from factorgraph.errors import InputError
from factorgraph.gpstime import GpsTime, leap_seconds
from factorgraph.types import Array, IntArray

BDT_GPST_S = 14.0  # GPST - BDT
PACKED = (b"\x1f\x9d", b"PK", b"BZ")  # Unix compress, zip, bzip2: left to hatanaka


@dataclass(frozen=True, slots=True)
class RinexText:
    """A decompressed file: its bytes, where lines begin and end, and its header."""

    path: Path
    data: bytes
    starts: IntArray  # (n_lines,) first byte of each line
    ends: IntArray  # (n_lines,) one past the last byte that is not blank or end of line
    version: float
    kind: str  # "O" observation, "N" navigation, "G" GLONASS navigation of RINEX 2, ...
    system: str  # the header's satellite system letter
    header: tuple[tuple[str, str], ...]  # (label, content padded to 60 columns)
    remarks: tuple[str, ...] = ()  # of the decompression

    @property
    def first_line(self) -> int:
        """Index of the first line after the header."""
        return len(self.header) + 1

    def line(self, index: int) -> str:
        return self.data[self.starts[index] : self.ends[index]].decode("ascii", "replace")

    def error(self, index: int, message: str) -> InputError:
        return InputError(f"{self.path}, line {index + 1}: {message}")

    def labelled(self, *labels: str) -> list[tuple[int, str]]:
        """(line index, content) of the header lines with one of the labels, in file order."""
        return [(i, content) for i, (label, content) in enumerate(self.header) if label in labels]


def read_rinex(path: Path) -> RinexText:
    """Open a RINEX file of any packing and read its header.

    Raises InputError for files that are absent, empty, not RINEX, of an unknown version or cut inside the header.
    """
    data, remarks = unpacked(path)
    if not data.strip():
        raise InputError(f"{path}: the file is empty")
    starts, ends = line_bounds(data)
    if b"RINEX VERSION / TYPE" not in data[: starts[1] if starts.size > 1 else None]:
        raise InputError(f"{path}, line 1: not a RINEX file (the first line must be labelled RINEX VERSION / TYPE)")
    header = _header(path, data, starts, ends)
    first = header[0][1]
    try:
        version = float(first[:9])
    except ValueError:
        raise InputError(f"{path}, line 1: RINEX version {first[:9].strip()!r} is not a number") from None
    if not 2.0 <= version < 5.0:
        raise InputError(f"{path}, line 1: RINEX version {version:.2f} is not supported (2, 3 and 4 are)")
    return RinexText(path, data, starts, ends, version, first[20].upper(), first[40].upper(), header, remarks)


def line_bounds(data: bytes) -> tuple[IntArray, IntArray]:
    """First byte, and one past the last byte that is not a carriage return, of each line."""
    raw = np.frombuffer(data, np.uint8)
    newline = np.flatnonzero(raw == 10)
    starts = np.concatenate([[0], newline + 1])
    ends = np.append(newline, raw.size)
    if starts[-1] == raw.size:
        starts, ends = starts[:-1], ends[:-1]
    ends = ends - ((ends > starts) & (raw[np.maximum(ends - 1, 0)] == 13))
    return starts.astype(np.int64), ends.astype(np.int64)


def unpacked(path: Path) -> tuple[bytes, tuple[str, ...]]:
    """A file's bytes, decompressed, and remarks on damage. Raises InputError where it cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror})") from None
    if data[:2] == b"\x1f\x8b":
        try:
            data = gzip.decompress(data)
        except (OSError, EOFError, zlib.error) as e:
            raise InputError(f"{path}: broken gzip file ({e})") from None
    if data.startswith(PACKED) or b"CRINEX VERS" in data[:100]:
        return _hatanaka(path, data)
    return data, ()


def _hatanaka(path: Path, data: bytes) -> tuple[bytes, tuple[str, ...]]:
    """Unpacked content, and what was lost of a damaged file."""
    import zipfile  # both only where a file asks for it

    import hatanaka

    # RuntimeError and NotImplementedError: zip files with a password or an unknown method
    broken = (ValueError, OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError, hatanaka.hatanaka.HatanakaException)
    try:
        with warnings.catch_warnings(record=True) as lost:
            warnings.simplefilter("always")
            data = bytes(hatanaka.decompress(data))
        return data, tuple(" ".join(str(w.message).split()) for w in lost)
    except broken as e:
        reason = str(e).strip().splitlines()
        raise InputError(f"{path}: cannot be decompressed ({reason[0] if reason else type(e).__name__})") from None


def _header(path: Path, data: bytes, starts: IntArray, ends: IntArray) -> tuple[tuple[str, str], ...]:
    lines: list[tuple[str, str]] = []
    for begin, end in zip(starts.tolist(), ends.tolist(), strict=True):
        text = data[begin:end].decode("ascii", "replace").ljust(60)
        label = text[60:80].strip()
        if label == "END OF HEADER":
            return tuple(lines)
        lines.append((label, text[:60]))
    raise InputError(f"{path}, line {len(lines)}: the file ends inside the header (no END OF HEADER)")


def number(field: str) -> float:
    """A FORTRAN number (exponent D or E); NaN where it is blank or unreadable."""
    try:
        return float(field.replace("D", "E").replace("d", "e"))
    except ValueError:
        return float("nan")


def triple(content: str, width: int = 14) -> Array:
    """Three numbers side by side, as header coordinates are written."""
    return np.array([number(content[width * k : width * (k + 1)]) for k in range(3)])


def full_year(year: int) -> int:
    """A two-digit RINEX 2 year to four digits: 80-99 are 19xx."""
    return year if year >= 100 else year + (1900 if year >= 80 else 2000)


def gpst(year: int, month: int, day: int, hour: int, minute: int, second: float, system: str) -> GpsTime:
    """An instant written in a satellite system's time ("C": BDT, "R": UTC, others GPST). ValueError for no such date."""
    time = GpsTime.from_calendar(full_year(year), month, day, hour, minute, second)
    if system == "C":
        return time + BDT_GPST_S
    return time + leap_seconds(time.calendar()) if system == "R" else time
