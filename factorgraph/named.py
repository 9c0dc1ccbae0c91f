"""What can be chosen by name and extended by installed packages, without importing any of it before it is chosen."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from factorgraph.errors import InputError


@dataclass(frozen=True, slots=True)
class Named:
    """One choice."""

    name: str
    path: str  # "package.module:class or instance"
    summary: str


@dataclass(frozen=True, slots=True)
class Names:
    """Choices of one kind: ours, and those of installed packages in an entry-point group."""

    kind: str
    group: str
    built_in: tuple[Named, ...]

    def all(self) -> dict[str, Named]:
        """By name, ours first; none is imported."""
        found = {choice.name: choice for choice in self.built_in}
        for entry in entry_points(group=self.group):
            found.setdefault(entry.name, Named(entry.name, entry.value, f"from {entry.dist.name if entry.dist else '?'}"))
        return found

    def named(self, name: str) -> Named:
        """A choice by name, not imported. Raises InputError with the nearest name for an unknown one."""
        known = self.all()
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean {near[0]}?" if near else "."
            raise InputError(f"no {self.kind} named {name}{hint} There are: {', '.join(known)}")
        return known[name]

    def create(self, name: str) -> Any:
        """An instance by name. Raises InputError as `named`."""
        module, _, attribute = self.named(name).path.partition(":")
        found = getattr(import_module(module), attribute)
        return found() if isinstance(found, type) else found
