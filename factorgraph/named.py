"""What can be chosen by name and extended by installed packages, without importing any of it before it is chosen."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from factorgraph.errors import InputError

MOST_SHOWN, FIRST_SHOWN = 12, 8  # names in an error


@dataclass(frozen=True, slots=True)
class Named:
    """One choice."""

    name: str
    path: str  # "package.module:class or instance"
    summary: str


@dataclass(frozen=True, slots=True)
class Family:
    """Many choices under one pattern, which are not listed one by one."""

    pattern: str  # as shown
    names: tuple[str, ...]
    module: str  # has each name as an attribute
    summary: str


@dataclass(frozen=True, slots=True)
class Names:
    """Choices of one kind: ours, those of installed packages in an entry-point group, and families of them."""

    kind: str
    group: str
    built_in: tuple[Named, ...]
    families: tuple[Family, ...] = ()

    def all(self) -> dict[str, Named]:
        """By name, ours first and without families; none is imported."""
        found = {choice.name: choice for choice in self.built_in}
        for entry in entry_points(group=self.group):
            found.setdefault(entry.name, Named(entry.name, entry.value, f"from {entry.dist.name if entry.dist else '?'}"))
        return found

    def named(self, name: str) -> Named:
        """A choice by name, not imported. Raises InputError with the nearest name for an unknown one."""
        known = self.all()
        if name in known:
            return known[name]
        for family in self.families:
            if name in family.names:
                return Named(name, f"{family.module}:{name}", family.summary)
        near = difflib.get_close_matches(name, [*known, *(n for family in self.families for n in family.names)], n=1)
        hint = f"; did you mean {near[0]}?" if near else "."
        shown = list(known)
        if len(shown) > MOST_SHOWN:
            shown = [*shown[:FIRST_SHOWN], f"{len(shown) - FIRST_SHOWN} more"]
        listed = ", ".join([*shown, *(family.pattern for family in self.families)])
        raise InputError(f"no {self.kind} named {name}{hint} There are: {listed}")

    def create(self, name: str) -> Any:
        """An instance by name. Raises InputError as `named`."""
        module, _, attribute = self.named(name).path.partition(":")
        found = getattr(import_module(module), attribute)
        return found() if isinstance(found, type) else found
