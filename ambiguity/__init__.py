"""Integer ambiguity resolution: estimators, validation, success rates, and the bookkeeping of double differences.

decorrelation, search      integer least squares, exact; `batch` for many epochs at once
bootstrapping, equivariant other integer estimators
partial, constrained       fixing a subset; known positions and baseline lengths
validation, simulation     tests of the best candidate, their thresholds, success rates
states                     satellites that come, go and slip, and a pivot that changes
"""

from ambiguity.batch import (
    IlsBatch,
    RoundedBatch,
    Strength,
    bootstrap_batch,
    integer_least_squares_batch,
    round_each_batch,
    strength_batch,
)
from ambiguity.bootstrapping import Rounded, adop, adop_success_rate, bootstrap, round_each, success_rate
from ambiguity.constrained import (
    FloatSolution,
    MixedResult,
    float_solution,
    length_constrained,
    mixed_integer_least_squares,
    position_prior,
)
from ambiguity.decorrelation import Decorrelation, decorrelate, factorise
from ambiguity.equivariant import BieResult, best_integer_equivariant
from ambiguity.partial import FixResult, FixStatus, condition, fix, fix_ordered
from ambiguity.search import IlsResult, integer_least_squares
from ambiguity.simulation import (
    AcceptanceRates,
    Rate,
    Simulation,
    SuccessRates,
    acceptance_rates,
    least_squares_upper_bound,
    simulate,
    simulated_success_rates,
    wilson,
)
from ambiguity.states import DoubleDifferences, Transition, change_pivot, follow, stack
from ambiguity.validation import (
    DifferenceTest,
    FailureRateThreshold,
    ProjectorTest,
    RatioTest,
    difference_test,
    ffrt_threshold,
    projector_test,
    ratio_test,
)

__all__ = [
    "AcceptanceRates",
    "BieResult",
    "Decorrelation",
    "DifferenceTest",
    "DoubleDifferences",
    "FailureRateThreshold",
    "FixResult",
    "FixStatus",
    "FloatSolution",
    "IlsBatch",
    "IlsResult",
    "MixedResult",
    "ProjectorTest",
    "Rate",
    "RatioTest",
    "Rounded",
    "RoundedBatch",
    "Simulation",
    "Strength",
    "SuccessRates",
    "Transition",
    "acceptance_rates",
    "adop",
    "adop_success_rate",
    "best_integer_equivariant",
    "bootstrap",
    "bootstrap_batch",
    "change_pivot",
    "condition",
    "decorrelate",
    "difference_test",
    "factorise",
    "ffrt_threshold",
    "fix",
    "fix_ordered",
    "float_solution",
    "follow",
    "integer_least_squares",
    "integer_least_squares_batch",
    "least_squares_upper_bound",
    "length_constrained",
    "mixed_integer_least_squares",
    "position_prior",
    "projector_test",
    "ratio_test",
    "round_each",
    "round_each_batch",
    "simulate",
    "simulated_success_rates",
    "stack",
    "strength_batch",
    "success_rate",
    "wilson",
]
