"""What several tests share: where recordings are, finite differences, consistency."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from factorgraph.types import Array

ROOT = Path(__file__).resolve().parent.parent


def shared_data(relative: str = "") -> Path:
    """A file or folder of the recordings that are not part of the project; skips the test where absent."""
    base = Path(os.environ.get("RELNAV_DATA", ROOT.parent / "shared" / "data"))
    path = base / relative
    if not path.exists():
        pytest.skip(f"recording {relative or base} is not here (set RELNAV_DATA to the folder that holds it)")
    return path


def wheel_file(package: str, relative: str) -> Path:
    """A file that arrives with an installed wheel; skips the test where it is not installed."""
    from importlib.util import find_spec

    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        pytest.skip(f"{package} is not installed")
    path = Path(next(iter(spec.submodule_search_locations))) / relative
    if not path.exists():
        pytest.skip(f"{package} brings no {relative}")
    return path


def install_entry_points(folder: Path, monkeypatch: pytest.MonkeyPatch, group: str, module: str, names: Sequence[str]) -> None:
    """Makes classes of a module known under their names in lower case as those of an installed package `plugins`.

    For this process and for those it starts.
    """
    place = folder / "site"
    info = place / "plugins-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plugins\nVersion: 1.0\n", encoding="utf-8")
    entries = [f"{name.lower()} = {module}:{name}" for name in names]
    (info / "entry_points.txt").write_text(f"[{group}]\n" + "\n".join(entries) + "\n", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(place), str(ROOT)]))
    monkeypatch.syspath_prepend(str(place))


def interruptible(command: Sequence[str]) -> list[str]:
    """The command, started so that it hears Ctrl-C even where the tests themselves run with SIGINT ignored."""
    start = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); os.execvp(sys.argv[1], sys.argv[1:])"
    return [sys.executable, "-c", start, *command]


def numerical_jacobian(f: Callable[[Array], Array], n: int, step: float) -> Array:
    """Central differences of f around zero perturbation, shape (m, n)."""
    return np.column_stack([(f(step * e) - f(-step * e)) / (2 * step) for e in np.eye(n)])


def assert_consistent(err: Array, P: Array, prob: float = 0.998) -> None:
    """Two-sided chi-square test: err (trials, n) at one epoch, P (trials, n, n).

    Source: Bar-Shalom et al. (2001), sec. 5.4.
    """
    nees = np.einsum("ti,ti->", err, np.linalg.solve(P, err[..., None])[..., 0])
    lo, hi = chi2.interval(prob, err.size)
    assert lo < nees < hi, f"NEES sum {nees:.1f} outside [{lo:.1f}, {hi:.1f}]"
