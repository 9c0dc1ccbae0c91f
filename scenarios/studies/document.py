"""Tables of a study, and how they look in a page of the documentation."""

from __future__ import annotations

from dataclasses import dataclass


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
