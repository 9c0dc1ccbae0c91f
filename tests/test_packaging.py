"""What an installation brings: declared packages, a tested lock, a complete wheel, a light command line."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from pydantic import BaseModel

from scenarios.flights import schema
from tests.helpers import ROOT

PACKAGES = ("ambiguity", "factorgraph", "scenarios", "swarm")
HEAVY = ("gtsam", "matplotlib", "numba", "numpy", "plotly", "pyarrow", "pydantic", "rich", "scipy")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LOCK = [line for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines() if not line.startswith("#")]


def canonical(name: str) -> str:
    """A distribution name as the index spells it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def names(requirements: list[str]) -> set[str]:
    return {canonical(re.match(r"[\w.-]+", r)[0]) for r in requirements}  # type: ignore[index]


def imported(package: str) -> set[str]:
    """Top-level names that a package's modules import anywhere."""
    found = set()
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.partition(".")[0])
    return found


def test_every_imported_package_is_declared_and_every_declared_one_is_imported() -> None:
    optional = PROJECT["optional-dependencies"]
    declared = names(PROJECT["dependencies"]) | names(optional["figures"]) | names(optional["optimisers"])
    used = set().union(*(imported(p) for p in PACKAGES)) - set(sys.stdlib_module_names) - set(PACKAGES)
    owners = packages_distributions()
    assert {canonical(owners[name][0]) for name in used} == declared


def test_the_lock_pins_every_requirement_to_one_version_and_names_no_place() -> None:
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+( ; .+)?", line) for line in LOCK), LOCK
    wanted = names(PROJECT["dependencies"]).union(*(names(r) for r in PROJECT["optional-dependencies"].values()))
    assert wanted <= names(LOCK)
    assert "cssrlib" in names(LOCK)  # make installs it for the demo


def test_the_command_line_imports_nothing_heavy() -> None:
    code = "import sys, scenarios.cli as c; c.main(['--help']); print(*sorted(sys.modules), sep='\\n', file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert not {m.partition(".")[0] for m in done.stderr.split()} & set(HEAVY)


def test_import_factorgraph_brings_no_engine() -> None:
    code = "import sys, factorgraph, factorgraph.registry; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert not set(done.stdout.split()) & {"gtsam", "matplotlib", "plotly"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Names of the files in a wheel built from a copy of the sources."""
    source = tmp_path_factory.mktemp("source")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    code = "import setuptools.build_meta as b; b.build_wheel('dist')"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True)
    (built,) = (source / "dist").glob("*.whl")
    return zipfile.ZipFile(built).namelist()


def test_the_wheel_holds_every_source_file_and_nothing_else(wheel: list[str]) -> None:
    files = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {name for name in wheel if ".dist-info/" not in name} == files


def test_the_wheel_carries_licence_command_and_type_marks(wheel: list[str]) -> None:
    assert {f"{package}/py.typed" for package in PACKAGES} <= set(wheel)
    assert any(Path(name).name == "LICENSE" for name in wheel)
    assert any(name.endswith("entry_points.txt") for name in wheel)


def table_models(model: type[BaseModel]) -> set[type[BaseModel]]:
    """The tables of `flight.toml` from one downwards."""
    found = {model}
    for field in model.model_fields.values():
        for kind in re.findall(r"scenarios\.flights\.schema\.(\w+)", repr(field.annotation)):
            child = getattr(schema, kind)
            if isinstance(child, type) and issubclass(child, BaseModel) and child not in found:
                found |= table_models(child)
    return found


def test_every_key_of_a_flight_is_documented() -> None:
    models = table_models(schema.Flight)
    assert len(models) >= 15
    keys = {name for model in models for name in model.model_fields}
    documented = set(re.findall(r"[a-z]\w*", (ROOT / "docs" / "flight-folder.md").read_text(encoding="utf-8")))
    assert not keys - documented


def test_the_documented_flight_parses() -> None:
    page = (ROOT / "docs" / "flight-folder.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    flight = schema.parse(example)
    assert [vehicle.name for vehicle in flight.vehicle] == ["leader", "follower"]
    assert flight.problem_settings.ambiguity.ratio_threshold == 2.5


def test_the_flight_of_the_readme_parses() -> None:
    (example,) = re.findall(r"```toml\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert len(schema.parse(example).vehicle) == 2


def test_links_of_the_documentation_lead_somewhere() -> None:
    for page in [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
