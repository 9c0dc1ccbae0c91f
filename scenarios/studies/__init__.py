"""Studies: the same question asked of many simulated flights.

study says what a study is and how one is written, catalogue finds it by name, runner runs its jobs (engines: worker
processes or a cluster; store: results that survive an interrupt). trials compares one method with truth and bound; its
names are here too, imported at first use, since every worker process imports this package.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenarios.studies.trials import Trial, Trials, replace_duration, run, trial, wrong_times

__all__ = ["Trial", "Trials", "replace_duration", "run", "trial", "wrong_times"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.trials"), name)
