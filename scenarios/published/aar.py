"""The aerial refuelling of the two-stage adaptive GNSS/INS publication (spec aar_two_stage.md, section 3).

The built-in scenario `aar` holds motion, sensors and noise. Here are the times of day at which it is flown, both readings
of the published noise, drawn starts of inertial filters, and the four data sets, which share every random number:

    1  no faults
    2  code faults of 5, 10, 20 and 40 m, eleven epochs each
    3  5 m/s on the velocity that the ambiguity filter predicts, twice eleven epochs
    4  both at once, 20 m and 5 m/s, twice eleven epochs

Code faults hit the UAV's receiver and are in the observations; velocity faults belong to an estimator's prediction, so a
data set only tells them. Windows are seconds of the flight, both ends included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np

from factorgraph.attitude import exp_so3, matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.filters.inertial import ImuModel, InertialStart
from factorgraph.measurements import GnssStream
from factorgraph.problem import NavigationProblem, Vehicle
from factorgraph.types import Array, BoolArray, IntArray
from scenarios.simulate.flight import Exact, Record, SimulatedFlight, exact, simulate
from scenarios.simulate.gnss import CodeFaults, GnssTable, with_code_faults
from scenarios.simulate.scenario import Scenario, load_scenario
from scenarios.simulate.streams import Streams

NAME = "aar"
TANKER, UAV = "tanker", "uav"
# Hours of the day with 10 or 11 satellites above 25 deg all through the flight. The publication's sky is not known: the first
# is the one whose single-epoch success (0.60) and mean ratio (4.1) come nearest to its 0.575 and 4.35; the others reach up to
# 0.9 and 6.5.
START_TIMES = (8.0, 11.0, 14.0, 17.0, 20.0, 23.0, 1.0, 5.0)
DATA_SETS = (1, 2, 3, 4)
Noise = Literal["dd", "literal"]


@dataclass(frozen=True, slots=True)
class Assumptions:
    """What the publication leaves open and is assumed here."""

    literal_code_m: float = 0.37  # published; read as double-difference values unless noise is "literal"
    literal_phase_m: float = 0.010
    literal_doppler_mps: float = 0.010
    position_m: float = 2.0  # initial errors of the inertial filters, per axis
    velocity_mps: float = 0.1
    level_deg: float = 0.05
    heading_deg: float = 0.3
    fault_probability: float = 0.3  # of a satellite at an epoch of data sets 2 and 4, at least one, random sign
    velocity_fault_mps: float = 5.0  # published; its direction is not
    velocity_direction: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of n


ASSUMED = Assumptions()
CODE_FAULTS = {
    2: ((200.0, 5.0), (500.0, 10.0), (800.0, 20.0), (1100.0, 40.0)),  # first second of eleven, size
    4: ((300.0, 20.0), (700.0, 20.0)),
}
VELOCITY_FAULTS = {3: (400.0, 600.0), 4: (300.0, 700.0)}
WINDOW_S = 10.0


@dataclass(frozen=True, slots=True)
class AarFlight:
    """A simulated flight without faults and what the inertial filters start from, by vehicle."""

    simulated: SimulatedFlight
    start: dict[str, InertialStart]
    start_index: int
    noise: Noise

    @property
    def problem(self) -> NavigationProblem:
        return self.simulated.problem

    @property
    def record(self) -> Record:
        return self.simulated.record

    @property
    def seed(self) -> int:
        return self.simulated.seed


@dataclass(frozen=True, slots=True)
class AarData:
    """One of the publication's data sets; K epochs, n rows of the UAV's observations."""

    number: int
    problem: NavigationProblem
    code_fault_m: Array  # (n,) put in, row by row
    faulted: BoolArray  # (K,) epoch within a window
    velocity_fault_mps: Array  # (K, 3) in n, to be added to the velocity that the ambiguity filter predicts


@dataclass(frozen=True, slots=True)
class TrueIntegers:
    """Single-difference integers, rover minus reference; differences of two columns are double differences."""

    t_s: Array  # (K,) time tags of the rover
    satellites: tuple[str, ...]  # that both receivers track at some time
    sd: Array  # (K, S) cycles, NaN where not both receivers track the satellite


def scenario(start: int = 0, noise: Noise = "dd") -> Scenario:
    """The description of the flight at one of `START_TIMES`; "literal" takes the published noise as undifferenced.

    Raises InputError for other starts.
    """
    if not 0 <= start < len(START_TIMES):
        raise InputError(f"start {start}: there are 0 to {len(START_TIMES) - 1}")
    base, later_s = load_scenario(NAME), 3600.0 * (START_TIMES[start] - START_TIMES[0])
    info = base.scenario.model_copy(update={"t0": base.scenario.t0 + later_s, "truth_hz": 1.0})
    environment = base.environment.model_copy(update={"sky_s": base.environment.sky_s + later_s})
    vehicles = tuple(base.vehicle)
    if noise == "literal":
        vehicles = tuple(v.model_copy(update={"gnss": _literal(v.gnss)}) for v in vehicles)
    return base.model_copy(update={"scenario": info, "environment": environment, "vehicle": vehicles})


def imu_model() -> ImuModel:
    """What the inertial filters are told of both IMUs: how they are simulated."""
    table = load_scenario(NAME).vehicle[0].imu
    assert table is not None
    noise = table.noise.noise
    return ImuModel(
        gyro_rps_rthz=noise.gyro_rps_rthz,
        accel_mps2_rthz=noise.accel_mps2_rthz,
        gyro_constant_rps=noise.gyro_bias_rps,
        gyro_markov_rps=table.gyro_gm_rps,
        gyro_markov_s=table.gyro_gm_s,
        accel_markov_mps2=table.accel_gm_mps2,
        accel_markov_s=table.accel_gm_s,
    )


def simulate_flight(seed: int, start: int = 0, noise: Noise = "dd") -> AarFlight:
    """The flight without faults (data set 1); all starts and both readings of the noise use the same random numbers.

    Raises InputError for starts that `START_TIMES` does not have.
    """
    simulated = simulate(scenario(start, noise), seed, _exact())
    starts = {v.name: inertial_start(simulated.problem, v, Streams(seed, f"/{v.name}")) for v in simulated.problem.vehicles}
    return AarFlight(simulated, starts, start, noise)


def data_set(flight: AarFlight, number: int) -> AarData:
    """One of the four data sets of a flight. Raises InputError for other numbers."""
    if number not in DATA_SETS:
        raise InputError(f"data set {number}: there are {', '.join(map(str, DATA_SETS))}")
    problem, uav = flight.problem, flight.problem.vehicle(UAV)
    antenna = uav.gnss
    assert antenna is not None
    faults = [
        CodeFaults(start_s=at, end_s=at + WINDOW_S, size_m=size, probability=ASSUMED.fault_probability)
        for at, size in CODE_FAULTS.get(number, ())
    ]
    streams = Streams(flight.seed, f"/{UAV}") / "gnss"
    hit, record = with_code_faults(antenna, flight.record.gnss[UAV], faults, streams)
    t = antenna.stream.t_s
    moved = _in_windows(t, VELOCITY_FAULTS.get(number, ()))
    vehicles = tuple(replace(v, gnss=hit) if v.name == UAV else v for v in problem.vehicles)
    direction = np.array(ASSUMED.velocity_direction)
    velocity = ASSUMED.velocity_fault_mps * direction / np.linalg.norm(direction)
    return AarData(
        number=number,
        problem=replace(problem, vehicles=vehicles),
        code_fault_m=record.outlier_m,
        faulted=moved | _in_windows(t, [at for at, _ in CODE_FAULTS.get(number, ())]),
        velocity_fault_mps=np.where(moved[:, None], velocity, 0.0),
    )


def true_integers(flight: AarFlight) -> TrueIntegers:
    """The integers that double-differenced phases hold, for any pivot; the same in all data sets."""
    streams = {v.name: v.gnss.stream for v in flight.problem.vehicles if v.gnss is not None}
    satellites = tuple(sorted(set(streams[TANKER].satellites) & set(streams[UAV].satellites)))
    t = streams[UAV].t_s
    N = {name: _spread(stream, flight.record.gnss[name].integer, satellites) for name, stream in streams.items()}
    return TrueIntegers(t, satellites, N[UAV] - N[TANKER])


@cache
def _exact() -> Exact:
    return exact(scenario(), seed=0)


def _literal(table: GnssTable | None) -> GnssTable | None:
    if table is None:
        return None
    sigmas = {"code_m": ASSUMED.literal_code_m, "phase_m": ASSUMED.literal_phase_m, "doppler_mps": ASSUMED.literal_doppler_mps}
    noise = table.noise.model_copy(update={**sigmas, "absolute_code_m": ASSUMED.literal_code_m})
    return table.model_copy(update={"noise": noise})


def _in_windows(t_s: Array, starts: Sequence[float]) -> BoolArray:
    windows = [CodeFaults(start_s=at, end_s=at + WINDOW_S, size_m=1.0).during(t_s) for at in starts]
    return np.any(windows, axis=0) if windows else np.zeros(len(t_s), bool)


def inertial_start(problem: NavigationProblem, vehicle: Vehicle, streams: Streams) -> InertialStart:
    """The truth at the start with drawn errors, and their covariance; attitude errors against the level at the place.

    streams: the vehicle's.
    """
    truth = vehicle.truth
    assert truth is not None and truth.v_n is not None and truth.q_nb is not None
    attitude = np.deg2rad([ASSUMED.level_deg, ASSUMED.level_deg, ASSUMED.heading_deg])
    C_nl = problem.frame.C_to_enu(truth.r_n[0]).T
    P = np.zeros((9, 9))
    P[:3, :3] = ASSUMED.position_m**2 * np.eye(3)
    P[3:6, 3:6] = ASSUMED.velocity_mps**2 * np.eye(3)
    P[6:, 6:] = C_nl @ np.diag(attitude**2) @ C_nl.T
    drawn = streams("inertial start").normal(0.0, 1.0, (3, 3))
    return InertialStart(
        r_n=truth.r_n[0] + ASSUMED.position_m * drawn[0],
        v_n=truth.v_n[0] + ASSUMED.velocity_mps * drawn[1],
        C_nb=exp_so3(-C_nl @ (attitude * drawn[2])) @ matrix_from_quat(truth.q_nb[0]),
        P=P,
    )


def _spread(stream: GnssStream, integer: IntArray, satellites: tuple[str, ...]) -> Array:
    """Integers (K, S) of a receiver, NaN where it does not track."""
    column = np.array([satellites.index(s) if s in satellites else -1 for s in stream.satellites])[stream.sat]
    out = np.full((len(stream.t_s), len(satellites)), np.nan)
    seen = column >= 0
    out[stream.epoch[seen], column[seen]] = integer[seen]
    return out
