"""How long a person waits for the command line: `python -m tests.benchmarks.bench_cli`.

Prints the median and the slowest wall time of some commands, each in a fresh interpreter.
"""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

REPEATS = 11
COMMANDS = (["--help"], ["smooth", "--help"], ["smoth"], ["methods"])


def wall_s(argv: list[str]) -> float:
    """Wall time of one `relnav argv`."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-m", "scenarios", *argv], capture_output=True, check=False)
    return time.perf_counter() - start


def main() -> None:
    print(f"{'relnav …':<16}{'median':>9}{'slowest':>9}")
    for argv in COMMANDS:
        wall_s(argv)  # compiled modules and disk cache
        times = [wall_s(argv) for _ in range(REPEATS)]
        print(f"{' '.join(argv):<16}{np.median(times):7.3f} s{max(times):7.3f} s")


if __name__ == "__main__":
    main()
