"""Where a flight is: a folder, a `flight.toml`, or a description that comes with relnav.

Descriptions name files of an installed package, or of a folder of recordings the user has (`--data`, or the
environment variable RELNAV_DATA).
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from factorgraph.errors import InputError
from scenarios.flights import schema
from scenarios.flights.schema import FILE_NAME, Flight, nearest_hint

FOLDER = Path(__file__).resolve().parent.parent / "data" / "flights"
DATA_VARIABLE = "RELNAV_DATA"


@dataclass(frozen=True, slots=True)
class Located:
    """A flight's description, the folder its files are relative to, and its name."""

    flight: Flight
    base: Path
    name: str
    source: Path


def names() -> list[str]:
    """The flights that come with relnav."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def locate(name: str | Path, data: Path | None = None) -> Located:
    """Find a flight by folder, file or name, and the folder of its files.

    Raises InputError for an unknown name (with the nearest), a missing file, package or data folder.
    """
    path = Path(name)
    if path.is_dir():
        path /= FILE_NAME
        if not path.is_file():
            raise InputError(f"{path.parent}: this folder has no {FILE_NAME}")
        return _located(path, path.resolve().parent.name, data, False)
    if path.suffix == ".toml" or path.is_file():
        return _located(path, path.resolve().parent.name if path.name == FILE_NAME else path.stem, data, False)
    if str(name) in names():
        return _located(FOLDER / f"{name}.toml", str(name), data, True)
    raise InputError(f"no flight {name}: neither a folder nor a name relnav knows{nearest_hint(str(name), names())}")


def _located(path: Path, name: str, data: Path | None, is_builtin: bool) -> Located:
    flight = schema.read(path)
    info = flight.flight
    if info.package:
        base = _package_folder(info.package) / info.data
    elif is_builtin:
        base = _recordings(name, info.data, data)
    else:
        base = (data or path.resolve().parent) / info.data
    if not base.is_dir():
        raise InputError(f"{path.name if is_builtin else path}: flight.data: no folder {base}")
    return Located(flight, base, info.name or name, path)


def _package_folder(package: str) -> Path:
    """Folder of an installed package, which is not imported."""
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise InputError(f"the files of this flight come with the package {package}; try: pip install {package}")
    return Path(next(iter(spec.submodule_search_locations)))


def _recordings(name: str, folder: str, data: Path | None) -> Path:
    """The folder `folder` of the user's recordings, or the given folder itself when it is that one."""
    root = data or (Path(os.environ[DATA_VARIABLE]) if os.environ.get(DATA_VARIABLE) else None)
    if root is None:
        raise InputError(
            f"flight {name}: its recordings do not come with relnav; give --data DIR, the folder that holds {folder}"
        )
    if not root.is_dir():
        raise InputError(f"--data {root}: no such folder")
    if (root / folder).is_dir():
        return root / folder
    if root.resolve().name == folder:
        return root
    there = sorted(p.name for p in root.iterdir() if p.is_dir())
    raise InputError(f"--data {root}: no folder {folder} in it{nearest_hint(folder, there) if there else ''}")
