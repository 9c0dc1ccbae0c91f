"""Solutions on disk: `solution.json` for everything but arrays, `arrays.npz` for those. Lossless, nothing is pickled.

The JSON mirrors the dataclasses; an array is {"array": key}, a number that JSON cannot hold {"number": "nan"}. Files
and folders are written beside their place and then renamed, so they are complete or as before.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shutil
import types
import typing
import zipfile
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np

from factorgraph.errors import InputError
from factorgraph.solution import Solution

FORMAT = "relnav solution"
VERSION = 1
TEXT, ARRAYS = "solution.json", "arrays.npz"


def save(solution: Solution, folder: Path) -> None:
    """Write a solution to a folder, replacing one that is there; tuples in `configuration` become lists.

    Raises InputError naming the folder when it cannot be written (permission, full disk); what was there is kept.
    """
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    tree = {"format": FORMAT, "version": VERSION, "solution": _encoded(solution, "", arrays)}

    def write(part: Path) -> None:
        part.mkdir()
        (part / TEXT).write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        np.savez(part / ARRAYS, allow_pickle=False, **arrays)

    replace_with(folder, write)


def load(folder: Path) -> Solution:
    """Read what `save` wrote. Raises InputError naming the file that is absent, damaged or of another version."""
    text, packed = folder / TEXT, folder / ARRAYS
    try:
        tree = json.loads(text.read_text(encoding="utf-8"))
        if not isinstance(tree, dict) or tree.get("format") != FORMAT:
            raise InputError(f"{text}: not a solution of relnav")
        if tree.get("version") != VERSION:
            raise InputError(f"{text}: version {tree.get('version')} cannot be read (only {VERSION}); run `relnav smooth` again")
        # np.load leaves a file it cannot read open when it opens it itself
        with packed.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            solution: Solution = _decoded(Solution, tree["solution"], arrays)
            return solution
    except OSError as error:
        name = error.filename or folder
        raise InputError(f"{name}: {error.strerror or error}; a folder that `relnav smooth` wrote is needed") from error
    except (zipfile.BadZipFile, EOFError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{folder}: the solution is damaged ({error}); run `relnav smooth` again") from error


def replace_with(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` make a file or folder beside its place, then move it there.

    Raises InputError naming the place for what the file system refuses. After an error or an interrupt the place holds
    what it held before.
    """
    part, aside = (path.with_name(f".{path.name}.{kind}-{os.getpid()}") for kind in ("part", "old"))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(part)
        if path.is_dir():  # a folder cannot be replaced in one step
            path.replace(aside)
        part.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}; what was there before is kept") from error
    finally:
        if aside.exists() and not path.exists():
            aside.replace(path)
        for left in (part, aside):
            _remove(left)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    elif path.exists():
        path.unlink()


def _encoded(value: Any, path: str, arrays: dict[str, np.ndarray[Any, Any]]) -> Any:
    """Plain JSON types of a value; arrays are collected by their dotted path."""
    if isinstance(value, np.ndarray):
        arrays[path] = value
        return {"array": path}
    if dataclasses.is_dataclass(value):
        return {f.name: _encoded(getattr(value, f.name), _join(path, f.name), arrays) for f in dataclasses.fields(value)}
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, dict):
        return {str(k): _encoded(v, _join(path, str(k)), arrays) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_encoded(v, _join(path, str(i)), arrays) for i, v in enumerate(value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return {"number": str(value)}
    if value is None or isinstance(value, str | int | float):
        return value
    raise InputError(f"solution.{path} is a {type(value).__name__}, which cannot be saved; use plain JSON types")


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


def _decoded(hint: Any, value: Any, arrays: Any) -> Any:
    """A value of the type a hint states, from plain JSON types."""
    if isinstance(value, dict) and set(value) == {"array"}:
        return arrays[value["array"]]
    if isinstance(value, dict) and set(value) == {"number"}:
        return float(value["number"])
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _decoded(next(a for a in args if a is not type(None)), value, arrays)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        hints = typing.get_type_hints(hint)
        return hint(**{name: _decoded(hints[name], v, arrays) for name, v in value.items()})
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint[value]
    if origin is tuple:
        items = args[:1] * len(value) if args[-1] is Ellipsis else args
        return tuple(_decoded(item, v, arrays) for item, v in zip(items, value, strict=True))
    if origin is dict:
        return {k: _decoded(args[1], v, arrays) for k, v in value.items()}
    return _decoded_plain(value)


def _decoded_plain(value: Any) -> Any:
    """Values of no stated type (`configuration`)."""
    if isinstance(value, dict):
        return float(value["number"]) if set(value) == {"number"} else {k: _decoded_plain(v) for k, v in value.items()}
    return [_decoded_plain(v) for v in value] if isinstance(value, list) else value
