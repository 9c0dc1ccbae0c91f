"""What every estimator returns.

Errors follow delta = estimate - truth; the attitude error phi obeys C_est = (I - [phi x]) C_true. Covariances
use the order of `STATE_SLICES`. A vehicle without attitude (no IMU) has NaN attitude and zero-size gyro and
accelerometer covariances filled with NaN.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from factorgraph.geodesy import LocalFrame
from factorgraph.gpstime import GpsTime
from factorgraph.measurements import Truth
from factorgraph.types import Array, BoolArray, IntArray

POS, VEL, ATT, BG, BA = (slice(i, i + 3) for i in range(0, 15, 3))


class Status(Enum):
    """Why the optimisation stopped."""

    CONVERGED = "converged"
    MAX_ITERATIONS = "iteration limit"
    STALLED = "no step reduces the cost"
    SINGULAR = "normal matrix is singular"
    INTERRUPTED = "interrupted"
    DIVERGED = "diverged"


class Fix(Enum):
    """Ambiguity status of a pair at an epoch, ordered from worst to best."""

    NONE = 0  # no phase
    FLOAT = 1
    PARTIAL = 2
    FIXED = 3


@dataclass(frozen=True, slots=True)
class VehicleSolution:
    """One vehicle's trajectory (body origin; the antenna where there is no attitude)."""

    name: str
    t_s: Array  # (n,)
    r_n: Array  # (n, 3) local frame
    v_n: Array  # (n, 3)
    q_nb: Array  # (n, 4) NaN without attitude
    bias_gyro: Array  # (n, 3) NaN without IMU
    bias_accel: Array  # (n, 3)
    P: Array  # (n, 15, 15) position, velocity, attitude, gyro bias, accelerometer bias; NaN where not estimated
    truth: Truth | None = None
    is_fixed: bool = False  # a base station


@dataclass(frozen=True, slots=True)
class PairSolution:
    """Rover relative to reference, resolved east-north-up at the reference's position."""

    reference: str
    rover: str
    t_s: Array  # (n,)
    baseline_enu: Array  # (n, 3) rover - reference
    velocity_enu: Array  # (n, 3)
    P: Array  # (n, 6, 6) baseline and relative velocity
    fix: IntArray  # (n,) values of Fix
    ratio: Array  # (n,) ratio test of the integers in use, NaN where none
    n_sat: IntArray  # (n,) satellites in the differences
    truth_enu: Array | None = None  # (n, 3) true baseline at t_s, NaN where unknown
    truth_velocity_enu: Array | None = None  # (n, 3)
    # from the vehicles' own points to those that the pair relates: antennas carried by a vehicle
    reference_lever_b: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rover_lever_b: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class AmbiguityTable:
    """One row per arc: a link's single-difference ambiguity of a satellite and signal over an interval."""

    link: tuple[str, ...] = ()  # "reference-rover"
    satellite: tuple[str, ...] = ()
    signal: tuple[str, ...] = ()
    t_start_s: Array = field(default_factory=lambda: np.zeros(0))
    t_end_s: Array = field(default_factory=lambda: np.zeros(0))
    float_cyc: Array = field(default_factory=lambda: np.zeros(0))  # relative to the datum arc of its group
    sigma_cyc: Array = field(default_factory=lambda: np.zeros(0))
    # at the arc's first phase not flagged as ambiguous by half a cycle; NaN when left float
    integer: Array = field(default_factory=lambda: np.zeros(0))
    state: tuple[str, ...] = ()  # "fixed", "float", "released", "datum"


@dataclass(frozen=True, slots=True)
class SlipTable:
    """One row per slip or end of an arc between two phases of a link's satellite and signal."""

    link: tuple[str, ...] = ()  # "reference-rover"
    satellite: tuple[str, ...] = ()
    signal: tuple[str, ...] = ()
    t_s: Array = field(default_factory=lambda: np.zeros(0))  # of the first phase after it
    cycles: Array = field(default_factory=lambda: np.zeros(0))  # what a repair took off; NaN where the arc ended
    sigma_cyc: Array = field(default_factory=lambda: np.zeros(0))  # before rounding
    repaired: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    cause: tuple[str, ...] = ()  # what found it: "gap", "loss of lock", "prediction", ...

    def of_link(self, link: str) -> SlipTable:
        """The rows of one link."""
        mine = np.flatnonzero(np.array([name == link for name in self.link], bool))
        texts = (tuple(column[i] for i in mine) for column in (self.link, self.satellite, self.signal, self.cause))
        names, satellites, signals, causes = texts
        numbers = (self.t_s[mine], self.cycles[mine], self.sigma_cyc[mine], self.repaired[mine])
        return SlipTable(names, satellites, signals, *numbers, causes)


OUTLIER_CLASSES = ("", "gross", "multipath", "nlos", "slip")  # "": no outlier


@dataclass(frozen=True, slots=True)
class ResidualTable:
    """One row per scalar measurement after the solution."""

    kind: tuple[str, ...] = ()  # table of kinds: "code", "phase", "doppler", "range", "position", "height", ...
    source: tuple[str, ...] = ()  # table of sources: link, vehicle or tag pair, with signal
    label: tuple[str, ...] = ()  # table of labels: satellite, axis, tag pair
    kind_index: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (n,)
    source_index: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    label_index: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    t_s: Array = field(default_factory=lambda: np.zeros(0))
    residual: Array = field(default_factory=lambda: np.zeros(0))  # measured - predicted, SI
    sigma: Array = field(default_factory=lambda: np.zeros(0))  # assumed standard deviation
    weight: Array = field(default_factory=lambda: np.zeros(0))  # robust weight, 1 = full
    outlier: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    azimuth_rad: Array = field(default_factory=lambda: np.zeros(0))  # NaN where not GNSS
    elevation_rad: Array = field(default_factory=lambda: np.zeros(0))
    cn0_dbhz: Array = field(default_factory=lambda: np.zeros(0))  # NaN where not known
    outlier_class: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (n,) index into OUTLIER_CLASSES

    def __post_init__(self) -> None:
        n = len(self.t_s)  # a method need not tell signal strength, and may call all its outliers gross
        if len(self.cn0_dbhz) != n:
            object.__setattr__(self, "cn0_dbhz", np.full(n, np.nan))
        if len(self.outlier_class) != n:
            object.__setattr__(self, "outlier_class", self.outlier.astype(np.int64))


@dataclass(frozen=True, slots=True)
class ParameterEstimate:
    """A constant estimated beside the states: posterior and prior. A ratio of sigmas near 1: the data do not tell it."""

    name: str  # "follower/gnss lever arm x"
    unit: str
    value: float
    sigma: float
    prior: float
    prior_sigma: float

    @property
    def is_told(self) -> bool:
        """Whether the data tell it at least twice as well as the prior does."""
        return self.sigma < 0.5 * self.prior_sigma


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """How the solution came about."""

    status: Status
    n_iterations: int
    cost: Array  # (n_iterations + 1,) 0.5 * sum of weighted squares
    runtime_s: dict[str, float] = field(default_factory=dict)  # stage -> seconds
    nis_t_s: Array = field(default_factory=lambda: np.zeros(0))  # epochs of nis
    nis: Array = field(default_factory=lambda: np.zeros(0))  # sum of squared normalised residuals per epoch
    nis_dof: Array = field(default_factory=lambda: np.zeros(0))  # effective degrees of freedom per epoch
    warnings: tuple[str, ...] = ()  # anything that makes the result degraded: printed, exit status 1
    notes: tuple[str, ...] = ()
    parameters: tuple[ParameterEstimate, ...] = ()


@dataclass(frozen=True, slots=True)
class Solution:
    """Everything known after solving a problem."""

    name: str
    method: str
    t0: GpsTime
    frame: LocalFrame
    vehicles: tuple[VehicleSolution, ...]
    pairs: tuple[PairSolution, ...]
    ambiguities: AmbiguityTable
    residuals: ResidualTable
    diagnostics: Diagnostics
    configuration: dict[str, object] = field(default_factory=dict)  # plain JSON types
    versions: dict[str, str] = field(default_factory=dict)
    carriers: dict[str, str] = field(default_factory=dict)  # carried antenna -> the vehicle that carries it
    slips: SlipTable = field(default_factory=SlipTable)

    def vehicle(self, name: str) -> VehicleSolution:
        """The solution of a vehicle, or of the vehicle that carries an antenna of that name."""
        return next(v for v in self.vehicles if v.name == self.carriers.get(name, name))

    def pair(self, reference: str, rover: str) -> PairSolution:
        return next(p for p in self.pairs if (p.reference, p.rover) == (reference, rover))

    @property
    def is_degraded(self) -> bool:
        return bool(self.diagnostics.warnings) or self.diagnostics.status is not Status.CONVERGED
