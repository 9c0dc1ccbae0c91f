"""Settings changed from the command line: `key=value`, nested keys with dots (`robust.code.width=3`)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from factorgraph.errors import InputError
from factorgraph.problem import Settings
from scenarios.flights.schema import changed_settings


def override(settings: Settings, assignments: Iterable[str]) -> Settings:
    """Settings with "key=value" assignments applied in order.

    Raises InputError for a text without "=", an unknown key (with the nearest one), a value of the wrong type and
    a value the settings refuse.
    """
    for text in assignments:
        key, equals, value = text.partition("=")
        if not equals:
            raise InputError(f"--set {text}: write KEY=VALUE, for instance max_state_interval_s=0.5")
        tree: Any = value.strip()
        for name in reversed(key.strip().split(".")):
            tree = {name: tree}
        try:
            settings = changed_settings(settings, tree)
        except InputError as error:
            raise InputError(f"--set {text}: {error}") from error
    return settings
