"""The command line: parse, call, turn the outcome into an exit code.

Only the standard library is imported here, so that `relnav --help` answers at once; the work is in
`scenarios.commands`, `scenarios.demo` and `scenarios.studies.command`.
"""

from __future__ import annotations

import argparse
import difflib
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from factorgraph.errors import InputError
from scenarios import guard

OUT_ROOT = Path("relnav-out")
DEFAULT_OUT = {"smooth": "{}", "compare": "compare-{}"}  # of a flight's name

EXAMPLES = """\
Examples
  relnav demo                               see what a run gives, in about two minutes
  relnav check my-flight                    what is in it, before anything is estimated
  relnav smooth my-flight                   results and report in relnav-out/my-flight
  relnav smooth my-flight --set ambiguity.fix=false --out float-only
  relnav simulate two-uav sim --seed 7      a flight with known truth, then: relnav smooth sim
  relnav compare sim --methods graph,eskf   methods side by side: accuracy, consistency, time, memory
  relnav study aar --quick                  estimators compared over several simulated flights
"""

EXIT_CODES = """\
Exit codes
  0    done
  1    finished, but the result is degraded: the reasons are printed
  2    wrong input, a failed write or a crash of a native library: one line says what would help
  3    an error in relnav itself: a traceback is printed, please report it
  130  stopped by Ctrl-C: what was finished is kept
"""


@dataclass(frozen=True, slots=True)
class Command:
    """A command: how it is listed, its options, and "module:function" that does it."""

    name: str
    usage: str
    summary: str
    group: str
    path: str
    add_options: Callable[[argparse.ArgumentParser], None] | None = None
    guarded: bool = False  # runs in a watched child process
    leader: str = ""  # "module:function" that starts the watched children itself, one for each part
    more_options: str = ""  # "module:function" that adds to the parser what the options read so far ask for


class _Parser(argparse.ArgumentParser):
    """Errors become InputError, with the nearest option where one is unknown."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message}; see {self.prog} --help")

    def parse(self, argv: Sequence[str]) -> argparse.Namespace:
        args, unknown = self.parse_known_args(argv)
        if unknown:
            known = [o for o in self._option_string_actions if o != guard.TRACE_OPTION]
            self.error(f"unknown argument {unknown[0]}{nearest(unknown[0].split('=')[0], known)}")
        return args


def nearest(name: str, known: Sequence[str]) -> str:
    """A hint ", did you mean …?" or nothing."""
    near = difflib.get_close_matches(name, known, n=1)
    return f", did you mean {near[0]}?" if near else ""


def _smooth_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flight", metavar="FLIGHT", help="a flight folder, its flight.toml, or the name of a catalogue flight")
    parser.add_argument("--method", metavar="NAME", default="graph", help="the estimator; `relnav methods` lists them (graph)")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="change a setting, as often as needed")
    parser.add_argument("--no-report", action="store_true", help="write the numbers only")
    parser.add_argument("--figures", action="store_true", help="write figures for print as well (needs matplotlib)")
    parser.add_argument(
        "--rate", metavar="imu|HZ", type=_rate, help="rate of the exported trajectories and baselines (that of the states)"
    )
    _data_option(parser)
    parser.add_argument("--out", metavar="DIR", type=Path, help=f"folder of the results ({OUT_ROOT}{os.sep}FLIGHT)")


def _compare_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flight", metavar="FLIGHT", help="a flight folder, its flight.toml, or the name of a catalogue flight")
    parser.add_argument("--methods", metavar="A,B,…", default="", help="the estimators; `relnav methods` lists them")
    parser.add_argument("--repeat", metavar="N", type=_whole(1), default=1, help="solve so often; times are medians (1)")
    parser.add_argument("--warm", action="store_true", help="run every method once before, so that no compilation is measured")
    parser.add_argument("--force", action="store_true", help="run the methods again that are finished in the folder")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="change a setting, as often as needed")
    _data_option(parser)
    parser.add_argument("--out", metavar="DIR", type=Path, help=f"folder of the results ({OUT_ROOT / 'compare-FLIGHT'})")


def _rate(text: str) -> float | str:
    """A rate in Hz, or "imu"."""
    if text == "imu":
        return text
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0 < rate < float("inf"):
        raise argparse.ArgumentTypeError(f"give imu or a rate in Hz, not {text}")
    return rate


def _simulate_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenario", metavar="SCENARIO", help="a scenario file, or the name of one that comes with relnav")
    parser.add_argument("out", metavar="OUT", type=Path, help="folder the flight is written to")
    parser.add_argument("--seed", metavar="N", type=int, default=1, help="seed of every random stream (1)")


def _check_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("flight", metavar="FLIGHT", help="a flight folder, its flight.toml, or the name of a catalogue flight")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    _data_option(parser)


def _report_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("solutions", metavar="SOLUTION", type=Path, nargs="+", help="a folder that `relnav smooth` wrote")
    parser.add_argument("--figures", action="store_true", help="write figures for print as well (needs matplotlib)")


def _study_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", nargs="?", help="the study; without one, all are listed")
    parser.add_argument("--trials", metavar="N", type=_whole(1), help="number of trials (as the study says)")
    parser.add_argument("--seed", metavar="FIRST", type=_whole(0), default=1, help="seed of the first trial (1)")
    parser.add_argument("--quick", action="store_true", help="few trials: minutes, and wider intervals")
    parser.add_argument("--workers", metavar="N", type=_whole(1), help="processes on this computer (one per processor)")
    parser.add_argument(
        "--engine", metavar="ENGINE", type=_engine, default="local", help="local, or dask://HOST:PORT for a dask cluster"
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help=f"folder of the results ({OUT_ROOT}{os.sep}study-NAME)")


def _whole(least: int) -> Callable[[str], int]:
    """The type of a whole number that is not below `least`."""

    def parse(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least:
            raise argparse.ArgumentTypeError(f"give a whole number from {least} on, not {text}")
        return number

    return parse


def _engine(text: str) -> str:
    host, _, port = text.removeprefix("dask://").rpartition(":")
    if text != "local" and not (text.startswith("dask://") and host and port.isdecimal() and 0 < int(port) < 1 << 16):
        raise argparse.ArgumentTypeError(f"give local or dask://HOST:PORT, not {text}")
    return text


def _demo_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=OUT_ROOT / "demo", help=f"folder of the results ({OUT_ROOT / 'demo'})"
    )


def _data_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", metavar="DIR", type=Path, help="where the recordings of catalogue flights are ($RELNAV_DATA)")


ESTIMATE, LOOK = "Estimate", "Look"
DO = "scenarios.commands"
COMMANDS = {
    c.name: c
    for c in (
        Command("demo", "", "smooth three recordings and a simulated flight", ESTIMATE, "scenarios.demo:demo", _demo_options),
        Command("smooth", "FLIGHT", "estimate a logged flight", ESTIMATE, f"{DO}:smooth", _smooth_options, True),
        Command(
            "simulate", "SCENARIO OUT", "write a flight with known truth", ESTIMATE, f"{DO}:simulate", _simulate_options, True
        ),
        Command(
            "compare",
            "FLIGHT",
            "methods side by side on one flight",
            ESTIMATE,
            "scenarios.compare:run_part",
            _compare_options,
            True,
            leader="scenarios.compare:compare",
        ),
        Command(
            "study",
            "[NAME [OPTIONS]]",
            "compare estimators over many trials",
            ESTIMATE,
            "scenarios.studies.command:study",
            _study_options,
            more_options="scenarios.studies.catalogue:add_options",
        ),
        Command("check", "FLIGHT", "what a flight holds: sensors, gaps, slips, drops", LOOK, f"{DO}:check", _check_options),
        Command("report", "SOLUTION…", "write the report of a solution again", LOOK, f"{DO}:report", _report_options),
        Command("methods", "", "list the estimators", LOOK, f"{DO}:methods"),
    )
}


def help_text() -> str:
    """What `relnav --help` prints."""
    lines = ["relnav: relative navigation of vehicle groups, from logged sensors to a report", ""]
    lines += ["Usage: relnav COMMAND [OPTIONS]      relnav COMMAND --help tells more", ""]
    for group in (ESTIMATE, LOOK):
        lines.append(group)
        lines += [f"  {f'{c.name} {c.usage}':<24}{c.summary}" for c in COMMANDS.values() if c.group == group]
        lines.append("")
    lines += ["Options", f"  {'--help, -h':<24}this text", f"  {'--version':<24}version and licence", "", EXAMPLES, EXIT_CODES]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit code; help exits by itself, errors in relnav itself are raised."""
    try:
        code = _run(list(sys.argv[1:] if argv is None else argv))
        sys.stdout.flush()
        return code
    except InputError as error:
        return _fail(str(error))
    except BrokenPipeError:  # the reader of our output has had enough
        _drop_stdout()
        return guard.DONE
    except OSError as error:
        if error.filename is None:
            _drop_stdout()
        return _fail(describe_os_error(error))
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] in ("ambiguity", "factorgraph", "scenarios", "swarm"):
            raise
        return _fail(f"the package {error.name} is not installed; try: pip install {error.name}")
    except guard.Stopped as end:
        print(f"relnav: {end}", file=sys.stderr)
        return end.code
    except KeyboardInterrupt:
        print("relnav: stopped; nothing is written yet", file=sys.stderr)
        return guard.INTERRUPTED


def describe_os_error(error: OSError) -> str:
    """One line for a file system error: what happened, and to which file."""
    text = error.strerror or str(error) or type(error).__name__
    return f"{error.filename}: {text}" if error.filename else text


def entry() -> NoReturn:
    """The console script; an unexpected error ends with BUG, which no result code uses."""
    sys.excepthook = _report_bug
    code = main()
    if guard.TRACE_OPTION in sys.argv or guard.is_stopping():
        # while the interpreter takes itself down, another interrupt would end it by signal, and native code may crash
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _run(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(help_text(), end="")
        return guard.DONE if argv else guard.FAILED
    if argv[0] == "--version":
        from importlib.metadata import version

        print(f"relnav {version('relnav')}, BSD-3-Clause")
        return guard.DONE
    if argv[0] not in COMMANDS:
        raise InputError(f"no command {argv[0]}{nearest(argv[0], list(COMMANDS))}; see relnav --help")
    command = COMMANDS[argv[0]]
    args = _parse(command, argv[1:])
    if command.name in DEFAULT_OUT and args.out is None:
        args.out = OUT_ROOT / DEFAULT_OUT[command.name].format(flight_name(args.flight))
    if not command.guarded:
        return _call(command.path, args)
    if args.run_trace is None and command.leader:
        return _call(command.leader, args)
    if args.run_trace is None:
        check_writable(args.out)
        return guard.run([*argv, *(["--out", str(args.out)] if command.name == "smooth" else [])], args.out)
    args.trace = guard.Trace(args.run_trace)
    return _call(command.path, args)


def _parse(command: Command, argv: list[str]) -> argparse.Namespace:
    parser = _Parser(
        prog=f"relnav {command.name}",
        usage=f"relnav {command.name} {command.usage}" if command.more_options else None,
        description=f"{command.summary[0].upper()}{command.summary[1:]}.",
        allow_abbrev=False,
    )
    if command.add_options is not None:
        command.add_options(parser)
    if command.guarded:
        parser.add_argument(guard.TRACE_OPTION, type=Path, help=argparse.SUPPRESS)
    if command.more_options:
        known, _ = parser.parse_known_args([a for a in argv if a not in ("-h", "--help")])
        _function(command.more_options)(parser, known)
    return parser.parse(argv)


def _call(path: str, args: argparse.Namespace) -> int:
    code: int = _function(path)(args)
    return code


def _function(path: str) -> Callable[..., Any]:
    """A function by "module:function", imported now."""
    module, _, name = path.partition(":")
    found: Callable[..., Any] = getattr(import_module(module), name)
    return found


def flight_name(flight: str) -> str:
    """The name results are filed under: of the folder, the description or the catalogue flight."""
    path = Path(flight).resolve()
    return path.parent.name if path.name == "flight.toml" else path.name.removesuffix(".toml")


def check_writable(folder: Path) -> None:
    """Try, before the long work, whether a folder of results can be made and written; nothing is left behind.

    Raises InputError where a file or a dead link is in the way, OSError where writing fails.
    """
    dead = next((p for p in (folder, *folder.parents) if p.is_symlink() and not p.exists()), None)
    if dead is not None:
        raise InputError(f"cannot write to {folder}: {dead} is a link to {dead.readlink()}, which is not there")
    existing = next(p for p in (folder, *folder.parents) if p.exists())
    if not existing.is_dir():
        raise InputError(f"cannot write to {folder}: {existing} is a file; choose another folder")
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from error


def _drop_stdout() -> None:
    """What is still buffered must not fail once more when the interpreter ends."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)


def _fail(message: str) -> int:
    print(f"relnav: error: {' '.join(message.split())}", file=sys.stderr)
    return guard.FAILED


def _report_bug(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if guard.is_stopping():
        print("relnav: stopped", file=sys.stderr, flush=True)
        os._exit(guard.INTERRUPTED)
    traceback.print_exception(kind, error, trace)
    print("relnav: this is an error in relnav itself; please report it with the lines above", file=sys.stderr, flush=True)
    sys.stdout.flush()
    os._exit(guard.BUG)  # the interpreter would end with 1, which means degraded
