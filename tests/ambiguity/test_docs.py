"""The page of this package: its examples run, its tables name all there is."""

from __future__ import annotations

import re
from pathlib import Path

import ambiguity

PAGE = (Path(__file__).parents[2] / "docs" / "ambiguity.md").read_text(encoding="utf-8")


def test_examples_run() -> None:
    examples = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert examples
    names: dict[str, object] = {}
    for example in examples:
        exec(compile(example, "docs/ambiguity.md", "exec"), names)


def test_every_public_function_is_in_the_table() -> None:
    functions = {name for name in ambiguity.__all__ if name[0].islower()}
    listed = set(re.findall(r"`(\w+)`", "".join(line.split("|")[1] for line in PAGE.splitlines() if line.startswith("| `"))))
    assert functions <= listed
