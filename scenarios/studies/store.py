"""Results of jobs in a folder: trials/KEY.npz for what is done, failed/KEY.txt for what went wrong.

A file takes its place when it is complete. It holds, beside the arrays, a JSON header with the job's parameters, the
version of relnav and a digest of study, parameters and version; a file of another digest, or one that does not check
(every member of the archive carries a CRC), is done again. One run at a time may use a folder: it holds a lock of the
operating system on `.lock`, which ends with its process however that ends.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import struct
import sys
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from enum import Enum
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from factorgraph.errors import InputError
from scenarios.solutions import replace_with

HEADER = "__job__"  # member of the archive
TRIALS, FAILED, LOCK, ASKED = "trials", "failed", ".lock", "study.json"
DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, KeyError, RuntimeError, TypeError, ValueError)


class State(Enum):
    """Of the file of a job."""

    DONE = "done"
    ABSENT = "absent"
    OUTDATED = "outdated"  # of other parameters or another version
    DAMAGED = "damaged"


def header(study: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """What tells a result apart. Raises TypeError or ValueError for parameters that are not plain JSON."""
    told = {"study": study, "parameters": dict(parameters), "relnav": relnav_version()}
    text = json.dumps(told, sort_keys=True, allow_nan=False)
    return {**told, "digest": hashlib.sha256(text.encode()).hexdigest()}


def relnav_version() -> str:
    """The installed version, or "source" where the sources are used without an installation."""
    try:
        return version("relnav")
    except PackageNotFoundError:
        return "source"


def pack(arrays: Mapping[str, NDArray[Any]], told: Mapping[str, Any]) -> bytes:
    """An .npz file with its header. Raises ValueError for arrays of objects."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **{HEADER: np.array(json.dumps(told)), **arrays})
    return buffer.getvalue()


def read(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a job. Raises InputError naming a file that cannot be read."""
    try:
        return {name: array for name, array in _members(path).items() if name != HEADER}
    except (*DAMAGE, OSError) as error:
        raise InputError(f"{path}: the results are damaged ({error}); run the study again") from error


def _members(path: Path) -> dict[str, NDArray[Any]]:
    # np.load leaves a file it cannot read open when it opens it itself
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


class Store:
    """The folder of a study."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, key: str) -> Path:
        """Where the arrays of a job are."""
        return self.folder / TRIALS / f"{key}.npz"

    def failure(self, key: str) -> Path:
        """Where it is told how a job failed."""
        return self.folder / FAILED / f"{key}.txt"

    def state(self, key: str, digest: str) -> State:
        """Whether the result of a job is there and can be used."""
        try:
            with self.path(key).open("rb") as file:
                with zipfile.ZipFile(file) as archive:
                    if archive.testzip() is not None:
                        return State.DAMAGED
                file.seek(0)
                with np.load(file, allow_pickle=False) as arrays:
                    told = json.loads(str(arrays[HEADER]))
            return State.DONE if told["digest"] == digest else State.OUTDATED
        except FileNotFoundError:
            return State.ABSENT
        except (*DAMAGE, OSError):
            return State.DAMAGED

    def put(self, key: str, packed: bytes) -> None:
        """Store a packed result. Raises InputError where it cannot be written."""
        replace_with(self.path(key), lambda part: part.write_bytes(packed))
        self.failure(key).unlink(missing_ok=True)

    def put_failure(self, key: str, text: str) -> None:
        """Store how a job failed. Raises InputError where it cannot be written."""
        replace_with(self.failure(key), lambda part: part.write_text(text, encoding="utf-8"))

    @contextmanager
    def claimed(self, study: str, asked: Mapping[str, object]) -> Iterator[None]:
        """The folder, made where needed, for this run alone; notes what was asked.

        Raises InputError where another run holds it or it belongs to another study, OSError where it cannot be written.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        # opened for appending: the text of the run that holds the lock must survive
        with (self.folder / LOCK).open("a+", encoding="utf-8") as file:
            if not _lock(file):
                file.seek(0)
                raise InputError(f"{self.folder} is in use by {file.read() or 'another run'}; wait, or choose another --out")
            file.truncate(0)
            file.write(f"process {os.getpid()} on {platform.node()}")
            file.flush()
            self._check_owner(study)
            for left in (self.folder / TRIALS).glob(".*.part-*"):  # of a run that was killed
                left.unlink()
            text = json.dumps({"study": study, "relnav": relnav_version(), **asked}, indent=1, default=str) + "\n"
            replace_with(self.folder / ASKED, lambda part: part.write_text(text, encoding="utf-8"))
            yield

    def _check_owner(self, study: str) -> None:
        owner = study
        with suppress(FileNotFoundError, ValueError, KeyError, TypeError):  # a damaged note is simply written again
            owner = json.loads((self.folder / ASKED).read_text(encoding="utf-8"))["study"]
        if owner != study:
            raise InputError(f"{self.folder} holds the study {owner}; choose another --out")


if sys.platform == "win32":
    import msvcrt

    def _lock(file: IO[str]) -> bool:
        try:
            file.seek(1 << 20)  # a byte beyond the text, which others may then read
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def _lock(file: IO[str]) -> bool:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True
