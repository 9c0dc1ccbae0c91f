"""`python -m scenarios` is `relnav`."""

from scenarios.cli import entry

if __name__ == "__main__":
    entry()
