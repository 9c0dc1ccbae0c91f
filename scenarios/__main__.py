"""`python -m scenarios` is `relnav`."""

import os
import sys

try:
    from scenarios.cli import entry
except KeyboardInterrupt:
    print("relnav: stopped; nothing is written yet", file=sys.stderr, flush=True)
    os._exit(130)

if __name__ == "__main__":
    entry()
