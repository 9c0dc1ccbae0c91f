"""Integer ambiguity resolution: decorrelation, search, partial fixing, validation, success rates.

`integer_least_squares` finds the nearest integers, `fix` decides which to keep, `condition` applies them.
"""

from ambiguity.bootstrapping import Rounded, adop, adop_success_rate, bootstrap, round_each, success_rate
from ambiguity.decorrelation import Decorrelation, decorrelate, factorise
from ambiguity.partial import FixResult, FixStatus, condition, fix
from ambiguity.search import IlsResult, integer_least_squares
from ambiguity.validation import RatioTest, ratio_test

__all__ = [
    "Decorrelation",
    "FixResult",
    "FixStatus",
    "IlsResult",
    "RatioTest",
    "Rounded",
    "adop",
    "adop_success_rate",
    "bootstrap",
    "condition",
    "decorrelate",
    "factorise",
    "fix",
    "integer_least_squares",
    "ratio_test",
    "round_each",
    "success_rate",
]
