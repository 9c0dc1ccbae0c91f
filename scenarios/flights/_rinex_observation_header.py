"""What the header of a RINEX observation file says, for versions 2 to 4 alike.

RINEX 2 names observations with two letters and leaves the tracking mode to a table: C1 is the civil code and P1 the
precise one of band 1; the phase, Doppler and strength of a band belong to the code the receiver would track it with
(C before P on band 1, P before C on band 2). RINEX 3.02 alone wrote BeiDou's 1561 MHz signals as band 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factorgraph.errors import InputError
from factorgraph.types import Array
from scenarios.flights._rinex_text import RinexText, number, triple
from scenarios.flights.signals import SYSTEMS

# RINEX 2 code observation -> RINEX 3 band and attribute, by system.
CODES_2 = {
    "G": {"C1": "1C", "P1": "1W", "C2": "2X", "P2": "2W", "C5": "5X"},
    "R": {"C1": "1C", "P1": "1P", "C2": "2C", "P2": "2P", "C3": "3X"},
    "E": {"C1": "1X", "C5": "5X", "C6": "6X", "C7": "7X", "C8": "8X"},
    "C": {"C1": "2I", "C2": "2I", "C6": "6I", "C7": "7I"},
    "J": {"C1": "1C", "C2": "2X", "C5": "5X", "C6": "6X"},
    "S": {"C1": "1C", "C5": "5X"},
    "I": {"C5": "5A"},
}
DEFAULT_ATTRIBUTE = {"G": "C", "R": "C", "E": "X", "C": "I", "J": "C", "S": "C", "I": "A"}


@dataclass(frozen=True, slots=True)
class ObservationHeader:
    """Observation types by system, in file order, named as in RINEX 3 ("L1C"; empty where nothing is known of it)."""

    types: dict[str, tuple[str, ...]]
    scale: dict[str, dict[str, float]]  # system -> type -> factor the file's numbers were multiplied by
    phase_shift_cyc: dict[str, float]  # signal -> correction the file's phases already contain
    channels: dict[str, int]  # GLONASS FDMA number
    time_system: str  # system letter: "C" BDT, "R" UTC, others GPST
    clock_applied: bool  # the receiver clock offsets were taken out of tags and observations
    approx_ecef: Array | None
    antenna_delta_m: Array  # (3,) height, east, north
    marker: str


def read_header(text: RinexText) -> ObservationHeader:
    """Interpret the header; InputError where the file is no observation file or declares no observation types."""
    if text.kind != "O":
        what = "a navigation file" if text.kind in "NGH" else f"RINEX type {text.kind!r}"
        raise text.error(0, f"this is {what}, expected an observation file")
    types = _types_2(text) if text.version < 3 else _types_3(text)
    if not any(types.values()):
        raise text.error(text.first_line - 1, "the header declares no observation types")
    approx = next((triple(c) for _, c in text.labelled("APPROX POSITION XYZ")), None)
    if approx is not None and not np.linalg.norm(np.nan_to_num(approx)) > 1e6:
        approx = None  # zeros stand for unknown
    first = next((c for _, c in text.labelled("TIME OF FIRST OBS")), "")
    # default by the file's own system; a mixed file counts GPS time
    system = {"GPS": "G", "GLO": "R", "GAL": "E", "QZS": "J", "BDT": "C", "IRN": "I", "BDS": "C"}.get(
        first[48:51], text.system if text.system in "RC" and text.system else "G"
    )
    return ObservationHeader(
        types=types,
        scale=_scale_factors(text, types),
        phase_shift_cyc=_phase_shifts(text),
        channels=_channels(text),
        time_system=system,
        clock_applied=any(c[:6].strip() == "1" for _, c in text.labelled("RCV CLOCK OFFS APPL")),
        approx_ecef=approx,
        antenna_delta_m=next((np.nan_to_num(triple(c)) for _, c in text.labelled("ANTENNA: DELTA H/E/N")), np.zeros(3)),
        marker=next((c.strip() for _, c in text.labelled("MARKER NAME")), ""),
    )


def _count(text: RinexText, line: int, content: str) -> int:
    try:
        return int(content)
    except ValueError:
        raise text.error(line, f"number of observation types {content.strip()!r} is not a number") from None


def _types_3(text: RinexText) -> dict[str, tuple[str, ...]]:
    listed: dict[str, list[str]] = {}
    promised: dict[str, tuple[int, int]] = {}
    system = ""
    for line, content in text.labelled("SYS / # / OBS TYPES"):
        if content[0] != " ":
            system = content[0]
            promised[system] = (_count(text, line, content[3:6]), line)
        listed.setdefault(system, []).extend(content[6:].split())
    for system, (n, line) in promised.items():
        if len(listed[system]) != n:
            raise text.error(line, f"{n} observation types of {system} announced, {len(listed[system])} listed")
    return {s: tuple(_name_3(s, t, text.version) for t in names) for s, names in listed.items() if s in SYSTEMS and s}


def _name_3(system: str, name: str, version: float) -> str:
    if len(name) == 2:  # attribute left blank in early files
        name += DEFAULT_ATTRIBUTE[system]
    if system == "C" and name[1] == "1" and (name[2] in "IQ" or (name[2] == "X" and 3.015 < version < 3.025)):
        name = name[0] + "2" + name[2]
    return name


def _types_2(text: RinexText) -> dict[str, tuple[str, ...]]:
    lines = text.labelled("# / TYPES OF OBSERV")
    names: list[str] = []
    promised, at = 0, 0
    for line, content in lines:
        if content[:6].strip():
            promised, at = _count(text, line, content[:6]), line
        names.extend(content[6:].split())
    if len(names) != promised:
        raise text.error(at, f"{promised} observation types announced, {len(names)} listed")
    return {system: tuple(_name_2(system, name, names) for name in names) for system in SYSTEMS}


def _name_2(system: str, name: str, present: list[str]) -> str:
    codes = CODES_2[system]
    if name[0] in "CP":
        return "C" + codes[name] if name in codes else ""
    if name[0] not in "LDS":
        return ""
    band = name[1]
    order = ("P", "C") if band == "2" else ("C", "P")
    known = [codes[kind + band] for kind in order if kind + band in codes]
    chosen = next((codes[kind + band] for kind in order if kind + band in present and kind + band in codes), None)
    return name[0] + (chosen or known[0]) if known else ""


def _scale_factors(text: RinexText, types: dict[str, tuple[str, ...]]) -> dict[str, dict[str, float]]:
    out: dict[str, dict[str, float]] = {}
    system, factor, named = "", 1.0, False
    for line, content in text.labelled("SYS / SCALE FACTOR"):
        if content[0] != " ":
            system, factor = content[0], number(content[2:6])
            named = bool(content[8:10].strip().lstrip("0"))
            if not factor > 0:
                raise text.error(line, f"scale factor {content[2:6].strip()!r} is not a positive number")
        names = content[10:].split() if named else types.get(system, ())
        out.setdefault(system, {}).update({_name_3(system, n, text.version): factor for n in names if n})
    return out


def _phase_shifts(text: RinexText) -> dict[str, float]:
    shifts = {c[0] + c[3:5]: number(c[6:14]) for _, c in text.labelled("SYS / PHASE SHIFT") if c[2:5].strip() and c[0] != " "}
    return {signal: shift for signal, shift in shifts.items() if shift == shift}


def _channels(text: RinexText) -> dict[str, int]:
    out: dict[str, int] = {}
    for _, content in text.labelled("GLONASS SLOT / FRQ #"):
        for k in range(8):
            entry = content[4 + 7 * k : 11 + 7 * k]
            satellite, channel = entry[:3].replace(" ", "0"), entry[3:].strip()
            if satellite[0] == "R" and channel.lstrip("+-").isdigit():
                out[satellite] = int(channel)
    return out


def check_unchanged(text: RinexText, begin: int, end: int, header: ObservationHeader) -> None:
    """Refuse a file whose observation types change after the header (event flag 4, lines begin to end)."""
    lines = [text.line(i).ljust(80) for i in range(begin, end)]
    inner = tuple((line[60:80].strip(), line[:60]) for line in lines)
    labels = {"SYS / # / OBS TYPES", "# / TYPES OF OBSERV"}
    if not any(label in labels for label, _ in inner):
        return
    part = replace(text, header=inner)
    try:
        types = _types_2(part) if text.version < 3 else _types_3(part)
    except InputError:
        types = {}
    if any(header.types.get(system) != names for system, names in types.items()) or not types:
        raise text.error(begin, "the observation types change inside the file; split it there (gfzrnx or teqc)")
