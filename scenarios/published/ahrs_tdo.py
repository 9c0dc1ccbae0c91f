"""Two UAVs in close company, from the publication of an adaptive relative filter on attitude systems and UWB (spec ahrs_tdo.md).

The built-in scenario `ahrs-tdo` holds motion, sensors and noise (section 3): the published figures, and for what is not
published the assumptions listed here. Phases are simulated and left out, since the system has none. More followers fly in
a V or in line behind the leader and differ from the first by their place, by the phase of its up and down, and in that they
are not pushed aside.

Times are seconds of the flight; relative vectors are follower - leader.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from factorgraph.attitude import matrix_from_quat
from factorgraph.errors import InputError
from factorgraph.filters import ahrs, tightly_coupled
from factorgraph.filters.ahrs import AhrsSettings, AhrsTrack, Aiding
from factorgraph.filters.inertial import ImuModel
from factorgraph.filters.tightly_coupled import TightSettings, TightTrack, point_start
from factorgraph.measurements import AttitudeStream
from factorgraph.models.receivers import receivers
from factorgraph.problem import NavigationProblem
from factorgraph.types import Array, BoolArray
from scenarios.flights.schema import LinkTable, TagTable
from scenarios.simulate.flight import Exact, Record, SimulatedFlight, exact, simulate
from scenarios.simulate.imu import ImuTable
from scenarios.simulate.motion_sensors import MagnetometerTable
from scenarios.simulate.ranging import RangeTable
from scenarios.simulate.scenario import Scenario, VehicleTable, load_scenario
from scenarios.simulate.trajectory import Formation

NAME = "ahrs-tdo"
LEADER, FOLLOWER = "leader", "follower"
MANOEUVRES = ((250.0, 253.0), (450.0, 453.0))  # the follower is pushed aside, both ends included
MOST = 10
Accel = Literal["0.01g", "0.1mg"]
Shape = Literal["v", "line"]
Ranges = Literal["all", "ring"]
ACCEL_MG: dict[str, float] = {"0.01g": 10.0, "0.1mg": 0.1}


@dataclass(frozen=True, slots=True)
class Assumptions:
    """What the publication leaves open and is assumed; trajectory and rates are in the scenario."""

    ahrs_deg: tuple[float, float, float] = (0.1, 0.1, 0.3)  # Gauss-Markov attitude errors about east, north, up
    ahrs_s: float = 5.0  # their correlation time
    ahrs_white_deg: float = 0.02
    accel_s: float = 3600.0  # correlation time, misprinted in the source
    accel_white_ug_rthz: float = 50.0
    gyro_white_deg_h: float = 0.1  # published; read as the standard deviation of a sample
    crystal: float = 1e-3  # published; ranges are longer by it
    place_m: tuple[float, float, float] = (30.0, -80.0, -10.0)  # right, front, up of the first follower
    in_line_m: float = 80.0  # between vehicles in line
    wave_phase_deg: float = 70.0  # from follower to follower
    magnetic_ut: float = 0.3  # white, a sample of 10 Hz
    iron_ut: float = 0.3  # hard iron that a calibration leaves, each axis
    turn_mps: float = 50.0  # of the vehicles, told to attitude filters without velocities
    drift_beta_hz: float = 1 / 3600  # of the receiver's clock, in the local filter
    drift_walk: float = 1e-3  # m/s per sqrt(s), likewise; simulated are 3e-4


ASSUMED = Assumptions()


@dataclass(frozen=True, slots=True)
class AhrsTdoFlight:
    """A simulated flight; the problem has no phases."""

    simulated: SimulatedFlight
    problem: NavigationProblem
    accel: Accel

    @property
    def record(self) -> Record:
        return self.simulated.record

    @property
    def seed(self) -> int:
        return self.simulated.seed

    @property
    def followers(self) -> tuple[str, ...]:
        return tuple(v.name for v in self.problem.vehicles if v.name != LEADER)

    def ahrs(self, name: str) -> AttitudeStream:
        """The attitude system of a vehicle: truth with drawn errors, 100 Hz. Its sigma counts correlated samples once."""
        return self.problem.vehicle(name).attitudes[0]


def scenario(
    accel: Accel = "0.01g",
    n: int = 2,
    shape: Shape = "v",
    ranges: Ranges = "all",
    told_scale: float | None = None,
    magnetometers: bool = False,
) -> Scenario:
    """The description of the flight of n vehicles.

    accel: the accelerometers' Gauss-Markov error, as printed or a hundredth of it. told_scale: how well estimators that ask
    know the ranges' scale, standard deviation; None: as large as it is. magnetometers: for an attitude filter in place of
    the attitude system of given errors. Raises InputError for other names and numbers.
    """
    _one_of("accel", accel, get_args(Accel))
    base = load_scenario(NAME)
    vehicles = formation(n, shape, base)
    names = [v.name for v in vehicles]
    vehicles = tuple(v.model_copy(update={"imu": _accelerometers(v.imu, accel)}) for v in vehicles)
    if magnetometers:
        compass = MagnetometerTable(field_n="model", sigma=ASSUMED.magnetic_ut, bias_sigma=ASSUMED.iron_ut)
        vehicles = tuple(v.model_copy(update={"magnetometers": (compass,)}) for v in vehicles)
    uwb = base.range[0].model_copy(update={} if told_scale is None else {"scale_sigma": told_scale})
    pairs = _pairs(names, ranges)
    update = {
        "vehicle": vehicles,
        "range": (uwb,) if n == 2 else tuple(_between(uwb, a, b) for a, b in pairs),
        "link": tuple(LinkTable(reference=LEADER, rover=name) for name in names[1:]),
    }
    return base.model_copy(update=update)


def formation(n: int, shape: Shape = "v", base: Scenario | None = None) -> tuple[VehicleTable, ...]:
    """The leader and n - 1 followers, alternately right and left behind it ("v") or one behind the other ("line").

    Raises InputError for other shapes and for n below 2 or above 10.
    """
    _one_of("shape", shape, get_args(Shape))
    if not 2 <= n <= MOST:
        raise InputError(f"n must be 2 to {MOST} vehicles, got {n}")
    base = base or load_scenario(NAME)
    leader, first = base.vehicle
    path = first.trajectory
    assert isinstance(path, Formation)
    more = []
    for k in range(n - 1):
        waves = tuple(w.model_copy(update={"phase_deg": w.phase_deg + ASSUMED.wave_phase_deg * k}) for w in path.waves)
        update = {"offset_m": _place(k, shape), "waves": waves, "pushes": path.pushes if k == 0 else ()}
        name = FOLLOWER if k == 0 else f"{FOLLOWER}-{k + 1}"
        more.append(first.model_copy(update={"name": name, "trajectory": path.model_copy(update=update)}))
    return leader, *more


def simulate_flight(
    seed: int,
    accel: Accel = "0.01g",
    n: int = 2,
    shape: Shape = "v",
    ranges: Ranges = "all",
    told_scale: float | None = None,
    magnetometers: bool = False,
) -> AhrsTdoFlight:
    """One flight; both readings of the accelerometer use the same random numbers. Arguments and errors as of `scenario`."""
    simulated = simulate(scenario(accel, n, shape, ranges, told_scale, magnetometers), seed, _exact(n, shape))
    return AhrsTdoFlight(simulated, without_phases(simulated.problem), accel)


def without_phases(problem: NavigationProblem) -> NavigationProblem:
    """The same problem as a receiver without carrier phases gives it."""
    vehicles = []
    for v in problem.vehicles:
        if v.gnss is not None:
            stream = v.gnss.stream
            bare = replace(stream, phase_cyc=np.full(stream.n_rows, np.nan), lli=np.zeros_like(stream.lli))
            v = replace(v, gnss=replace(v.gnss, stream=bare))
        vehicles.append(v)
    return replace(problem, vehicles=tuple(vehicles))


def imu_model(accel: Accel = "0.01g") -> ImuModel:
    """What filters are told of every IMU: how it is simulated."""
    table = scenario(accel).vehicle[0].imu
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


def local_settings(use_doppler: bool = False) -> TightSettings:
    """What the local filters are told of receivers: code alone, as published, or with Doppler."""
    noise = load_scenario(NAME).vehicle[0].gnss
    assert noise is not None
    given = noise.noise.noise
    return TightSettings(
        code_m=given.code_m,
        doppler_mps=given.doppler_mps,
        elevation=given.elevation,
        use_doppler=use_doppler,
        clock_walk=0.0,
        drift_walk=ASSUMED.drift_walk,
        drift_beta_hz=ASSUMED.drift_beta_hz,
    )


def local_filters(flight: AhrsTdoFlight, settings: TightSettings | None = None) -> dict[str, TightTrack]:
    """Every vehicle's own filter of 20 states, from its first single-point solution and its attitude system's first attitude.

    Nothing of the truth enters. Source: spec ahrs_tdo.md, section 2.3.
    """
    settings, model = settings or local_settings(), imu_model(flight.accel)
    P_attitude = np.diag(np.deg2rad(np.hypot(ASSUMED.ahrs_deg, ASSUMED.ahrs_white_deg)) ** 2)
    tracks = {}
    for name, receiver in receivers(flight.problem).items():
        C_nb = matrix_from_quat(flight.ahrs(name).q_nb[0])
        start = point_start(receiver, flight.problem.frame, C_nb, P_attitude)
        tracks[name] = tightly_coupled.run(receiver, flight.problem.frame, start, model, settings)
    return tracks


def attitude_filters(flight: AhrsTdoFlight, aided: bool = False) -> dict[str, AhrsTrack]:
    """Every vehicle's attitude filter on its own IMU and magnetometer, instead of the attitude system of given errors.

    aided: by the velocities of single GNSS epochs, else gravity counts less in turns. Raises InputError for a flight without
    magnetometers. Source: spec ahrs_tdo.md, section 2.1.
    """
    frame, tracks = flight.problem.frame, {}
    for name, receiver in receivers(flight.problem).items():
        vehicle, aiding = receiver.vehicle, None
        if vehicle.imu is None or not vehicle.magnetics:
            raise InputError(f"vehicle {name}: an attitude filter needs an IMU and a magnetometer; simulate with magnetometers")
        if aided:
            times, point = receiver.antenna.stream.t_s - receiver.clock_s, receiver.point
            r_n, v_n = frame.from_ecef(point.r_ecef), frame.rotate_from_ecef(point.v_ecef)
            aiding = Aiding(times, r_n, v_n, receiver.antenna.noise.doppler_mps)
        settings = AhrsSettings(turn_mps=0.0 if aided else ASSUMED.turn_mps)
        tracks[name] = ahrs.run(vehicle.imu, vehicle.imu_noise, frame, vehicle.magnetics[0], aiding, settings)
    return tracks


def with_attitudes(flight: AhrsTdoFlight, streams: dict[str, AttitudeStream]) -> AhrsTdoFlight:
    """The same flight with other attitudes, by vehicle, for instance those of an attitude filter (`AhrsTrack.stream`)."""
    vehicles = tuple(replace(v, attitudes=(streams[v.name],)) for v in flight.problem.vehicles)
    return replace(flight, problem=replace(flight.problem, vehicles=vehicles))


def manoeuvring(t_s: Array) -> BoolArray:
    """Times (k,) within the windows of `MANOEUVRES`."""
    inside: BoolArray = np.any([(t_s >= start) & (t_s <= end) for start, end in MANOEUVRES], axis=0)
    return inside


@cache
def _exact(n: int, shape: Shape) -> Exact:
    return exact(scenario(n=n, shape=shape), seed=0)


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise InputError(f"{name} must be one of {', '.join(known)}, got {value}")


def _place(k: int, shape: Shape) -> tuple[float, float, float]:
    """Right, front, up of the k-th follower."""
    right, front, up = ASSUMED.place_m
    if shape == "line":
        return 0.0, -ASSUMED.in_line_m * (k + 1), 0.0
    rank, side = 1 + k // 2, 1 if k % 2 == 0 else -1
    return side * rank * right, rank * front, rank * up


def _pairs(names: list[str], ranges: Ranges) -> list[tuple[str, str]]:
    _one_of("ranges", ranges, get_args(Ranges))
    if ranges == "all" or len(names) == 2:
        return list(combinations(names, 2))
    return list(zip(names, [*names[1:], names[0]], strict=True))


def _between(table: RangeTable, a: str, b: str) -> RangeTable:
    """A set of its own, so that all pairs measure at the epochs instead of taking turns."""
    tags = tuple(TagTable(name=name, vehicle=name) for name in (a, b))
    return table.model_copy(update={"name": f"{table.name}-{a}-{b}", "tags": tags})


def _accelerometers(table: ImuTable | None, accel: Accel) -> ImuTable:
    assert table is not None
    noise = table.noise.model_copy(update={"accel_bias_mg": ACCEL_MG[accel]})
    return table.model_copy(update={"accel_gm_mg": ACCEL_MG[accel], "noise": noise})
