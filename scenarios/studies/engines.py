"""Where jobs run: worker processes of this computer, or a dask cluster. Both give the same results.

An engine takes tasks (a job, and a function of no arguments packed by pickle) and yields each job with its reply as soon
as that is known; closing it stops what still runs. A local worker has one process, one thread for linear algebra and one
job at a time, so that a crash of native code is told of the job that caused it and costs no other. Workers are deaf to
Ctrl-C: the process that started them stops them.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from factorgraph.errors import InputError
from scenarios.guard import how_it_ended
from scenarios.studies.study import Job

LOCAL, DASK = "local", "dask://"
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMBA_NUM_THREADS")
CONNECT_S = 15  # for a cluster to answer


@dataclass(frozen=True, slots=True)
class Done:
    """A job's packed result."""

    packed: bytes


@dataclass(frozen=True, slots=True)
class Failed:
    """How a job failed: one line, and all that is known."""

    why: str
    details: str


Reply = Done | Failed
Task = tuple[Job, bytes]
Replies = Generator[tuple[Job, Reply], None, None]
Engine = Callable[[Sequence[Task]], Replies]


def choose(text: str, workers: int | None) -> Engine:
    """An engine from what --engine and --workers say. Raises InputError for what does not fit together."""
    if text == LOCAL:
        return partial(local, workers=workers if workers is not None else _cores())
    if workers is not None:
        raise InputError("--workers belongs to the engine local; a cluster has as many workers as were started for it")
    return partial(cluster, address=text.removeprefix(DASK))


def _cores() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def execute(packed: bytes) -> Reply:
    """Run a task in a worker."""
    try:
        task: Callable[[], bytes] = pickle.loads(packed)
        return Done(task())
    except Exception as error:  # whatever a study raises is the failure of one job and must not stop the others
        first = next(iter(str(error).splitlines()), "")
        return Failed(f"{type(error).__name__}: {first}" if first else type(error).__name__, traceback.format_exc())


def local(tasks: Sequence[Task], workers: int) -> Replies:
    """Runs tasks in processes of this computer, in their order."""
    waiting = deque(tasks)
    with TemporaryDirectory(prefix="relnav-") as folder:
        busy: dict[Connection, _Worker] = {}
        try:
            while waiting or busy:
                while waiting and len(busy) < workers:
                    worker = _Worker(Path(folder), waiting.popleft())
                    busy[worker.connection] = worker
                for connection in wait(list(busy)):
                    assert isinstance(connection, Connection)
                    worker = busy[connection]
                    job, reply = worker.take()
                    if worker.is_alive and waiting:
                        worker.give(waiting.popleft())
                    else:
                        worker.end()
                        del busy[connection]
                    yield job, reply
        finally:
            for worker in busy.values():
                worker.end()


class _Worker:
    """A process and the task it has."""

    def __init__(self, folder: Path, task: Task) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._trace = folder / f"{id(self)}.txt"
        self._process = _start(context, theirs, self._trace)
        theirs.close()  # the only one left is the worker's, so that its death ends the connection
        self.is_alive = True
        self.give(task)

    def give(self, task: Task) -> None:
        self._job = task[0]
        with suppress(BrokenPipeError, ConnectionResetError):  # a worker that died at its start is told when it is heard
            self.connection.send_bytes(task[1])

    def take(self) -> tuple[Job, Reply]:
        try:
            reply: Reply = self.connection.recv()
        except (EOFError, ConnectionResetError):
            reply = self._death()
        return self._job, reply

    def _death(self) -> Failed:
        self.is_alive = False
        self._process.join()
        how = how_it_ended(self._process.exitcode or 0)
        trace = self._trace.read_text(encoding="utf-8", errors="replace") if self._trace.exists() else ""
        return Failed(f"its process ended ({how})", f"The process of this job ended by itself: {how}.\n\n{trace}")

    def end(self) -> None:
        self.connection.close()
        self._process.kill()
        self._process.join()


def _start(context: SpawnContext, connection: Connection, trace: Path) -> multiprocessing.process.BaseProcess:
    process = context.Process(target=_serve, args=(connection, str(trace)), daemon=True)
    with _deaf(), _single_threaded():
        process.start()
    return process


@contextmanager
def _deaf() -> Iterator[None]:
    """Processes started here never hear Ctrl-C: an ignored signal stays ignored in a child."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Processes started here use one thread each; libraries read these variables when they are loaded."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(connection: Connection, trace: str) -> None:
    """A worker: does tasks until nobody gives any."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with open(trace, "w", encoding="utf-8") as file, suppress(EOFError, BrokenPipeError, ConnectionResetError):
        faulthandler.enable(file)
        while True:
            connection.send(execute(connection.recv_bytes()))


def cluster(tasks: Sequence[Task], address: str) -> Replies:
    """Runs tasks on a dask cluster, whose workers need relnav and the study's package.

    Raises InputError where no scheduler answers at "HOST:PORT", ModuleNotFoundError where dask.distributed is absent.
    """
    distributed: Any = import_module("distributed")  # an optional package without types
    try:
        client = distributed.Client(f"tcp://{address}", timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise InputError(f"--engine {DASK}{address}: no dask scheduler answers there ({error})") from error
    with client:
        jobs = {client.submit(execute, packed, pure=False): job for job, packed in tasks}
        try:
            for future in distributed.as_completed(list(jobs)):
                yield jobs.pop(future), _reply(future)
        finally:
            client.cancel(list(jobs))


def _reply(future: Any) -> Reply:
    """Of a finished future; an error is the cluster's, for instance a worker that died again and again."""
    error = future.exception()
    if error is None:
        reply: Reply = future.result()
        return reply
    return Failed(f"{type(error).__name__}: {error}", str(error))
