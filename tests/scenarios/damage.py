"""Commands run on flight folders that are damaged in stated ways."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from factorgraph.solution import Solution
from scenarios import guard, solutions

TOML = "flight.toml"
Damage = Callable[[Path], object]


@dataclass(frozen=True, slots=True)
class Run:
    """How a command ended."""

    code: int
    err: list[str]  # lines
    printed: str
    out: Path

    @property
    def solution(self) -> Solution:
        return solutions.load(self.out / "solution")


Relnav = Callable[..., Run]


def one_error_line(run: Run) -> str:
    """The only line on stderr, which must be relnav's error line; the exit code must say wrong input."""
    assert run.code == guard.FAILED, run.err
    (line,) = run.err
    assert line.startswith("relnav: error: ")
    return line


def content(file: str, change: Callable[[bytes], bytes]) -> Damage:
    """Rewrites a file."""
    return lambda folder: (folder / file).write_bytes(change((folder / file).read_bytes()))


def key(old: str, new: str) -> Damage:
    """Rewrites part of flight.toml, which must be there."""

    def change(text: bytes) -> bytes:
        assert old.encode() in text
        return text.replace(old.encode(), new.encode())

    return content(TOML, change)


def rows(file: str, change: Callable[[list[str]], Iterable[str]]) -> Damage:
    """Rewrites the rows of a table, below its header."""

    def change_text(text: bytes) -> bytes:
        head, *body = text.decode().splitlines()
        return "\n".join([head, *change(body), ""]).encode()

    return content(file, change_text)


def cells(file: str, column: int, value: str, first: int = 0, last: int = 10**6) -> Damage:
    """Writes a value into a column, from row `first` to before `last`."""

    def change(body: list[str]) -> list[str]:
        split = [row.split(",") for row in body]
        for row in split[first:last]:
            row[column] = value
        return [",".join(row) for row in split]

    return rows(file, change)


def later(file: str, seconds: float) -> Damage:
    """Adds to the times of a table."""

    def change(body: list[str]) -> list[str]:
        split = [row.split(",", 1) for row in body]
        return [f"{float(t) + seconds},{rest}" for t, rest in split]

    return rows(file, change)


def satellites(file: str, systems: str, most: int = 99, first: int = 0, last: int = 10**6) -> Damage:
    """Keeps only satellites of some systems, at most so many, at the epochs from `first` to before `last`."""

    def change(text: bytes) -> bytes:
        head, *epochs = re.split(r"(?m)^(?=>)", text.decode())
        for i, epoch in enumerate(epochs[first:last], first):
            line, *records = epoch.splitlines(keepends=True)
            kept = [record for record in records if record[0] in systems][:most]
            epochs[i] = f"{line[:32]}{len(kept):3d}{line[35:]}{''.join(kept)}"
        return "".join([head, *epochs]).encode()

    return content(file, change)


def missing(file: str) -> Damage:
    return lambda folder: (folder / file).unlink()


def both(*damages: Damage) -> Damage:
    return lambda folder: [damage(folder) for damage in damages]


def swap(a: str, b: str) -> Damage:
    def damage(folder: Path) -> None:
        first, second = (folder / a).read_bytes(), (folder / b).read_bytes()
        (folder / a).write_bytes(second)
        (folder / b).write_bytes(first)

    return damage


def share(x: float) -> Callable[[bytes], bytes]:
    return lambda text: text[: int(x * len(text))]


def scaled(row: str, first: int, last: int, factor: float) -> str:
    split = row.split(",")
    split[first:last] = [str(float(cell) * factor) for cell in split[first:last]]
    return ",".join(split)
