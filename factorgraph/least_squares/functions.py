"""From models to evaluation: CasADi functions with named inputs and outputs, built once, and run over all samples of a flight.

`linearised` differentiates a model and puts its local columns to zero, where most of the expression vanishes. `Samples` runs
the function over n samples at once on NumPy arrays (n, size), which are CasADi's own column-major (size, n) without a copy.

With `codegen` the function is written as C, compiled and loaded; without a compiler CasADi's virtual machine runs it. Compiled
functions are kept in the user's cache directory under a hash of code and compiler; a file there is never written twice.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Hashable, Mapping
from pathlib import Path

import casadi as ca
import numpy as np

from factorgraph.models.symbolic.symbols import Model, Symbols, derivatives, flat
from factorgraph.types import Array

CODEGEN_VARIABLE = "FACTORGRAPH_CODEGEN"  # "1": compile functions where not told otherwise
FLAGS = ("-O1", "-fPIC", "-shared", "-ffp-contract=off")  # no fused operations: results of the virtual machine
COMPILERS = ("cc", "gcc", "clang")


def codegen_wanted() -> bool:
    """Whether the environment asks for compiled functions."""
    return os.environ.get(CODEGEN_VARIABLE, "") == "1"


@functools.cache
def linearised(model: Model, *options: Hashable, codegen: bool = False) -> ca.Function:
    """A model's outputs and Jacobians at zero local columns.

    Inputs are the model's. Outputs are its outputs (size,), and for every output y and group of columns c `y_c`
    (size * columns,), row by row.
    """
    s = Symbols()
    outputs = model(s, *options)
    values, Jacobians = derivatives(s, list(outputs.values()))
    names, expressions = [], []
    for name, y, J in zip(outputs, values, Jacobians, strict=True):
        names.append(name)
        expressions.append(ca.densify(y))
        at = 0
        for group, part in s.columns.items():
            if part.numel():
                names.append(f"{name}_{group}")
                expressions.append(flat(J[:, at : at + part.numel()]))
            at += part.numel()
    inputs = list(s.inputs)
    name = f"{model.__name__}_linearised"
    f = ca.Function(name, list(s.inputs.values()), expressions, inputs, names, {"cse": True})
    return compiled(f) if codegen else f


class Samples:
    """One function over n samples: inputs are kept between calls, outputs are made anew."""

    def __init__(self, function: ca.Function, n: int) -> None:
        self.n = n
        self._names = [str(name) for name in function.name_in()]
        self._sizes = {name: int(function.numel_in(name)) for name in self._names}
        self._outputs = [(str(name), int(function.numel_out(name))) for name in function.name_out()]
        self.inputs: dict[str, Array] = {}
        self._mapped = function.map(n)
        self._buffer, self._run = self._mapped.buffer()

    def set(self, inputs: Mapping[str, Array]) -> None:
        """Set inputs, each (n, size) or, the same for all samples, (size,); those that the function does not have are ignored."""
        for name in self._names:
            if name not in inputs:
                continue
            given, size = np.asarray(inputs[name], float), self._sizes[name]
            if given.size != self.n * size:
                given = np.broadcast_to(given, (self.n, size))
            self.inputs[name] = np.ascontiguousarray(given).reshape(self.n, size)
            self._buffer.set_arg(self._names.index(name), self.inputs[name].data)  # type: ignore[call-arg]

    def run(self) -> dict[str, Array]:
        """Outputs (n, size). Raises KeyError where an input was never set."""
        missing = [name for name in self._names if name not in self.inputs]
        if missing:
            raise KeyError(f"{self._mapped.name()} has no {', '.join(missing)}")
        results = {}
        for i, (name, size) in enumerate(self._outputs):
            results[name] = np.empty((self.n, size))
            self._buffer.set_res(i, results[name].data)  # type: ignore[call-arg]
        self._run()
        return results


# compiled functions


def cache_directory() -> Path:
    """Where compiled functions are kept."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = str(Path.home() / "Library" / "Caches")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "relnav" / "functions"


def compiled(f: ca.Function, directory: Path | None = None) -> ca.Function:
    """The function as compiled code, kept in `directory`; the function itself where no compiler is found or it fails."""
    compiler = next((path for name in COMPILERS if (path := shutil.which(name))), None)
    if compiler is None:
        return f
    generator = ca.CodeGenerator(f"{f.name()}.c")
    generator.add(f)
    code = generator.dump()
    told = "\n".join((code, compiler, *FLAGS, platform.platform()))
    directory = cache_directory() if directory is None else directory
    library = directory / f"{f.name()}_{hashlib.sha256(told.encode()).hexdigest()[:32]}.so"
    try:
        if not library.exists():
            _compile(compiler, code, library)
        return ca.external(f.name(), str(library))
    except (OSError, subprocess.CalledProcessError):
        return f


def _compile(compiler: str, code: str, library: Path) -> None:
    """Compile beside the library and move the result there whole. Raises OSError, CalledProcessError."""
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        source, made = Path(folder) / "function.c", Path(folder) / "function.so"
        source.write_text(code)
        subprocess.run([compiler, *FLAGS, str(source), "-o", str(made), "-lm"], check=True, capture_output=True)
        if not library.exists():
            os.replace(made, library)
