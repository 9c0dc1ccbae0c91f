"""The recursive methods by name, each also smoothed, as NAME-rts.

`registry` names them in one table; a name of this module is a method, such as `getattr(methods, "ukf-rts")`.
"""

from __future__ import annotations

from factorgraph.filters.adaptive import Level
from factorgraph.filters.charts import EULER, INVARIANT
from factorgraph.filters.correctors import Adaptive, Huber, Iterated, RobustFading, StrongTracking
from factorgraph.filters.recursive import Filter, Recursive
from factorgraph.filters.sigma_points import cubature, unscented
from factorgraph.registry import RECURSIVE

SMOOTHED = "-rts"
FILTERS = {
    "eskf": Filter(),
    "ekf": Filter(chart=EULER),
    "iekf": Filter(Iterated),
    "inekf": Filter(chart=INVARIANT),
    "ukf": Filter(rule=unscented),
    "ckf": Filter(rule=cubature),
    "srukf": Filter(rule=unscented, root=True),
    "srckf": Filter(rule=cubature, root=True),
    "strong-tracking": Filter(StrongTracking),
    "huber": Filter(Huber),
    "rackf": Filter(RobustFading),
    "sage-husa": Filter(lambda: Adaptive(Level("fading"), True)),
    "iae": Filter(lambda: Adaptive(Level("window"), False)),
    "rae": Filter(lambda: Adaptive(Level("window"), True)),
    "forgetting": Filter(lambda: Adaptive(Level("forgetting"), True)),
}


def create(name: str, integers: bool | None = None) -> Recursive:
    """A method of `FILTERS`, or smoothed; `integers` as in `Recursive`. Raises KeyError for an unknown one."""
    alone = name.removesuffix(SMOOTHED)
    return Recursive(name, RECURSIVE[alone], FILTERS[alone], name.endswith(SMOOTHED), integers)


def __getattr__(name: str) -> Recursive:
    if name.removesuffix(SMOOTHED) not in FILTERS:
        raise AttributeError(f"module {__name__} has no attribute {name}")
    return create(name)
