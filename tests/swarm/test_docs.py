"""The pages about optimisers, correctors and the relative filter: their examples run, their tables name all there is."""

from __future__ import annotations

import re

import pytest

import swarm
from tests.helpers import ROOT

PAGES = ("swarm", "correctors", "relative-filter")


def page(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", PAGES)
def test_examples_run(name: str) -> None:
    examples = re.findall(r"```python\n(.*?)```", page(name), re.DOTALL)
    assert examples
    names: dict[str, object] = {}
    for example in examples:
        exec(compile(example, f"docs/{name}.md", "exec"), names)


def test_every_method_is_in_the_table() -> None:
    listed = re.findall(r"^\| `([\w-]+)` \|", page("swarm"), re.MULTILINE)
    assert listed == list(swarm.METHODS)
