"""What a study writes: tables in a page of the documentation, parameters in words, JSON that compares well."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from scenarios.solutions import replace_with


@dataclass(frozen=True, slots=True)
class Table:
    """Plain texts; the first `n_text` columns are words, the others numbers."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    n_text: int = 1


def markdown_table(table: Table) -> str:
    """Head and rows in Markdown."""
    marks = ["---" if i < table.n_text else "--:" for i in range(len(table.head))]
    lines = [table.head, marks, *table.rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"


def markdown_section(table: Table) -> str:
    """A table below its title, with its note."""
    return f"## {table.title}\n\n{markdown_table(table)}" + (f"\n{table.note}\n" if table.note else "")


def parameter_table(parameters: Mapping[str, str]) -> Table:
    """Parameters by name; without rows where there are none."""
    return Table("Parameters", ("parameter", "value"), tuple(parameters.items()), n_text=2)


def parameter_texts(parameters: Mapping[str, object]) -> dict[str, str]:
    """Parameters in words."""
    return {name: _text(value) for name, value in parameters.items()}


def _text(value: object) -> str:
    return (
        ", ".join(map(_text, value))
        if isinstance(value, list | tuple)
        else f"{value:g}"
        if isinstance(value, float)
        else str(value)
    )


def json_text(content: Mapping[str, object]) -> str:
    """JSON with one item of its lists a line: small, and readable in a comparison of versions."""

    def short(value: object) -> str:
        return json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)

    parts = []
    for key, value in content.items():
        if isinstance(value, list) and value and isinstance(value[0], list | dict):
            parts.append(f"{short(key)}:[\n" + ",\n".join(short(item) for item in value) + "\n]")
        else:
            parts.append(f"{short(key)}:{short(value)}")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def write_text(path: Path, content: str) -> Path:
    """A file that takes its place when it is complete. Raises InputError where it cannot be written."""
    replace_with(path, lambda part: part.write_text(content, encoding="utf-8"))
    return path
