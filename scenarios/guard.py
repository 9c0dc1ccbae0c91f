"""Long commands run in a watched child process, so that a crash of native code is told and Ctrl-C always works.

The child is the same command with `--run-trace FILE`. It writes a line `stage: …` to that file whenever it begins
something new, and Python's fault handler appends its trace there when a native library dies. The parent forwards
Ctrl-C (and SIGTERM and SIGHUP, which mean the same here), waits, and turns a death by signal into one line.
"""

from __future__ import annotations

import faulthandler
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import IO, NoReturn

DONE, DEGRADED, FAILED, BUG, INTERRUPTED = 0, 1, 2, 3, 130
TRACE_OPTION = "--run-trace"
CRASH_FILE = "crash.txt"
POLL_S = 0.2
RESEND_S = 0.5  # the child may not have installed its handler yet; it acts on the first signal only

_ROOT = Path(__file__).resolve().parent.parent
_stopping = threading.Event()


class Stopped(Exception):
    """An early end of a command: its exit code and the line that tells why."""

    def __init__(self, code: int, message: str) -> None:
        super().__init__(message)
        self.code = code


class Trace:
    """The child's side: tells the parent what is going on, and arms the fault handler and the signals."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8")
        faulthandler.enable(self._file)
        signal.signal(signal.SIGINT, _interrupt_once)
        for number in _requests_to_end():
            signal.signal(number, _interrupt_once)

    def stage(self, name: str) -> None:
        """Note what begins now."""
        self._file.write(f"stage: {name}\n")
        self._file.flush()


def _interrupt_once(signum: int, frame: FrameType | None) -> NoReturn:
    # one interrupt: what follows is saving and cleaning up, which must not be interrupted again
    _stopping.set()
    for number in (signal.SIGINT, *_requests_to_end()):
        signal.signal(number, _ignore)
    raise KeyboardInterrupt


def _ignore(signum: int, frame: FrameType | None) -> None:
    """Unlike SIG_IGN this may be set while another signal waits to be handled: Python complains of those it then finds."""


@contextmanager
def one_interrupt() -> Iterator[None]:
    """For commands that are not watched: within, the first Ctrl-C, SIGTERM or SIGHUP raises KeyboardInterrupt, later ones
    are ignored, to the end of the process. What is ignored on purpose stays so.
    """
    interrupts = [] if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else [signal.SIGINT]
    restore = {number: signal.signal(number, _interrupt_once) for number in (*interrupts, *_requests_to_end())}
    try:
        yield
    finally:
        for number, handler in restore.items():
            if not _stopping.is_set():
                signal.signal(number, handler)


def is_stopping() -> bool:
    """Whether an interrupt has arrived; native libraries may turn it into an error of theirs."""
    return _stopping.is_set()


def _requests_to_end() -> list[signal.Signals]:
    """SIGTERM and SIGHUP, where they exist and are not ignored on purpose (nohup)."""
    found = (getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP"))
    return [number for number in found if number is not None and signal.getsignal(number) is not signal.SIG_IGN]


def run(argv: Sequence[str], out: Path, quiet: bool = False) -> int:
    """Run `relnav argv` in a child and return its exit code; a crash is printed as one line and is FAILED.

    `out` is the folder of results: the trace of a crash is kept there. `quiet` drops what it prints on stdout.
    """
    code, message = watch(argv, out, stdout=subprocess.DEVNULL if quiet else None)
    if message:
        print(f"relnav: {message}", file=sys.stderr)
    return code


def watch(
    argv: Sequence[str],
    out: Path,
    on_stage: Callable[[str], None] | None = None,
    stdout: int | None = None,
    stderr: IO[bytes] | None = None,
) -> tuple[int, str]:
    """Run `relnav argv` in a child; its exit code, and the line that tells of a crash or a sudden end, else "".

    `out` as in `run`. `on_stage` hears of each stage the child is in, about every POLL_S; `stdout` and `stderr` are where
    the child prints.
    """
    with tempfile.TemporaryDirectory(prefix="relnav-") as folder:
        trace = Path(folder) / "trace.txt"
        child = _start([*argv, TRACE_OPTION, str(trace)], stdout, stderr)
        code, was_killed = _wait(child, None if on_stage is None else lambda: on_stage(_stage(trace)))
        if was_killed or code == -signal.SIGINT:
            return INTERRUPTED, f"stopped at once; what was finished is in {out}"
        if code not in (DONE, DEGRADED, FAILED, BUG, INTERRUPTED):
            return FAILED, f"error: {_describe(code, trace)}{_keep(trace, out)}"
        return code, ""


def _start(argv: list[str], stdout: int | None, stderr: IO[bytes] | None) -> subprocess.Popen[bytes]:
    path = os.pathsep.join(p for p in (str(_ROOT), os.environ.get("PYTHONPATH", "")) if p)
    env = {**os.environ, "PYTHONPATH": path}
    # -P: a folder or file in the working directory must not hide a module
    command = [sys.executable, "-P", "-m", "scenarios", *argv]
    # an ignored signal stays ignored in the child until Trace takes it: no half-started interpreter is interrupted
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return subprocess.Popen(command, env=env, stdout=stdout, stderr=stderr)
    finally:
        signal.signal(signal.SIGINT, before)


def _wait(child: subprocess.Popen[bytes], tick: Callable[[], None] | None) -> tuple[int, bool]:
    """The child's exit code, and whether a second Ctrl-C killed it; `tick` is called while waiting."""
    restore = {number: signal.signal(number, signal.default_int_handler) for number in _requests_to_end()}
    interrupts = 0
    try:
        while True:
            try:
                return child.wait(RESEND_S if interrupts else None if tick is None else POLL_S), interrupts > 1
            except KeyboardInterrupt:
                interrupts += 1
                _interrupt(child, interrupts > 1)
            except subprocess.TimeoutExpired:
                if interrupts:
                    _interrupt(child, False)
                elif tick is not None:
                    tick()
    finally:
        for number, handler in restore.items():
            signal.signal(number, handler)


def _interrupt(child: subprocess.Popen[bytes], at_once: bool) -> None:
    if at_once:
        child.kill()
    elif os.name == "posix":  # elsewhere the console tells the child itself
        child.send_signal(signal.SIGINT)


def how_it_ended(code: int) -> str:
    """What the exit code of a process that ended by itself says: the signal, or the status."""
    if -code in {s.value for s in signal.Signals}:
        return f"signal {-code}, {signal.Signals(-code).name}"
    return f"status {code & 0xFFFFFFFF:#x}"


def _describe(code: int, trace: Path) -> str:
    how = how_it_ended(code)
    if os.name == "posix" and code == -signal.SIGKILL:
        what = f"the run was killed ({how}), often because memory ran out,"
    else:
        what = f"a native library crashed ({how})"
    text = _text(trace)
    files = ((Path(file), line) for file, line in re.findall(r'File "([^"]+)", line (\d+)', text))
    where = next((f" at {file.relative_to(_ROOT)}:{line}" for file, line in files if _is_ours(file)), "")
    return f"{what} in the stage {_stage(trace)!r}{where}"


def _stage(trace: Path) -> str:
    """What a child noted last."""
    stages = re.findall(r"^stage: (.*)$", _text(trace), re.MULTILINE)
    return stages[-1] if stages else "start"


def _text(trace: Path) -> str:
    return trace.read_text(encoding="utf-8", errors="replace") if trace.exists() else ""


def _is_ours(file: Path) -> bool:
    return file.is_relative_to(_ROOT) and file.relative_to(_ROOT).parts[0] in ("ambiguity", "factorgraph", "scenarios", "swarm")


def _keep(trace: Path, out: Path) -> str:
    """Copies the trace of a crash to the results; what to add to the message."""
    if not trace.exists():
        return ""
    out.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(trace, out / CRASH_FILE)
    return f"; trace in {out / CRASH_FILE}"
