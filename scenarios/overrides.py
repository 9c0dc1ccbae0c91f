"""Settings changed from the command line: `key=value`, nested keys with dots (`robust.code.width=3`)."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterable
from typing import Any, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from factorgraph.errors import InputError
from factorgraph.problem import Settings


def override(settings: Settings, assignments: Iterable[str]) -> Settings:
    """Settings with "key=value" assignments applied in order.

    Raises InputError for a text without "=", an unknown key (with the nearest one), a value of the wrong type and
    a value the settings refuse.
    """
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"--set {text}: write KEY=VALUE, for instance max_state_interval_s=0.5")
        try:
            settings = _replaced(settings, key.strip(), value.strip())
        except InputError as error:
            raise InputError(f"--set {text}: {error}") from error
    return settings


def _replaced(owner: Any, path: str, value: str) -> Any:
    """A copy of a dataclass or dictionary with the entry at a dotted path read from text."""
    name, _, rest = path.partition(".")
    children = _children(owner)
    if name not in children:
        near = difflib.get_close_matches(name, children, n=1)
        raise InputError(f"no setting {name}" + (f", did you mean {near[0]}?" if near else f"; there are {', '.join(children)}"))
    child = children[name]
    if rest and not _children(child):
        raise InputError(f"{name} has no parts, so not {path}")
    if not rest and _children(child):
        raise InputError(f"{name} has parts: set one of {', '.join(f'{name}.{part}' for part in _children(child))}")
    new = _replaced(child, rest, value) if rest else _read(get_type_hints(type(owner))[name], value)
    return {**owner, name: new} if isinstance(owner, dict) else dataclasses.replace(owner, **{name: new})


def _children(owner: Any) -> dict[str, Any]:
    if isinstance(owner, dict):
        return owner
    return {f.name: getattr(owner, f.name) for f in dataclasses.fields(owner)} if dataclasses.is_dataclass(owner) else {}


def _read(hint: Any, value: str) -> Any:
    try:
        return TypeAdapter(hint, config=ConfigDict(allow_inf_nan=False)).validate_strings(value)
    except ValidationError as error:
        raise InputError(error.errors()[0]["msg"]) from error
