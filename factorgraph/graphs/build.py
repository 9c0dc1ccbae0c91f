"""From a navigation problem to a graph: receivers prepared, rows sorted into blocks, factors between states.

The absolute code of a rover is not used where its link's reference has absolute information of its own: undifferenced
code of the reference and differences carry everything once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from factorgraph.errors import InputError
from factorgraph.graphs.blocks import (
    CODE,
    DOPPLER,
    HEIGHT,
    PHASE,
    POSITION,
    RANGE,
    Block,
    Endpoint,
    GnssBlock,
    HeightBlock,
    IonosphereBlock,
    JointBlock,
    MotionBlock,
    Offset,
    PositionBlock,
    RangeBlock,
    Rows,
)
from factorgraph.graphs.inertial import add_imu_factors, add_priors, motion_keys, motion_prior_rows
from factorgraph.graphs.optimizer import Graph
from factorgraph.graphs.parameters import Parameter, Parameters
from factorgraph.graphs.rows import in_grid, plain_rows, sensor_end, time_offset
from factorgraph.graphs.variables import VehicleVariables
from factorgraph.measurements import Tag
from factorgraph.models.arcs import Arcs, find_arcs
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.gnss import (
    WAVELENGTH_L1_M,
    PairedRows,
    elevation_scale,
    one_code_per_satellite,
    pair_rows,
    system_of,
)
from factorgraph.models.receivers import Receiver, corrected
from factorgraph.problem import Antenna, Link, NavigationProblem, RangeModel
from factorgraph.start import interpolate
from factorgraph.types import Array, BoolArray, IntArray

HEADING_SIGMA_RAD = 3.0
HINT_SIGMA_RAD = 0.3
HELD = 1e-6  # prior of a component that is not estimated beside one that is


@dataclass(slots=True)
class GnssLink:
    """A link's block and what the ambiguity resolution needs of it."""

    link: Link
    block: GnssBlock
    row_reference: IntArray  # (n,) row of the block -> row of the reference's stream
    row_rover: IntArray
    arc_group: IntArray  # (arcs,) clock group of each arc
    arc_satellite: list[str]
    arc_signal: list[str]
    arc_start_s: Array
    arc_end_s: Array
    state: list[str] = field(default_factory=list)  # per arc: "float", "fixed", "released", "datum"
    slips: dict[str, int] = field(default_factory=dict)
    key_base: int = 0
    float_cyc: Array = field(default_factory=lambda: np.zeros(0))  # before fixing
    float_sigma: Array = field(default_factory=lambda: np.zeros(0))

    def make_free(self, arc: int) -> None:
        """Give an arc its variable back."""
        self.block.amb_key[arc] = int(gtsam.symbol("a", self.key_base + arc))


def _gnss_rows(
    kind: IntArray,
    group_index: IntArray,
    factor: IntArray,
    t_s: Array,
    sigma: Array,
    *,
    label: list[str],
    label_index: IntArray,
    source: str,
    group: list[str],
    azimuth_rad: Array,
    elevation_rad: Array,
) -> Rows:
    """Rows already sorted by factor, kind, group."""
    n_groups = int(group_index.max()) + 1 if len(group_index) else 1
    clocks = CommonGroups.from_labels((factor * 3 + kind) * n_groups + group_index)
    factors = CommonGroups.from_labels(factor)
    return Rows(kind, t_s, sigma, factors, clocks, source, label, label_index, group, group_index, azimuth_rad, elevation_rad)


def _without_singles(order: IntArray, clock_label: IntArray) -> IntArray:
    """Rows of `order` whose clock group has at least two rows; a single row only serves its own clock."""
    _, inverse, count = np.unique(clock_label[order], return_inverse=True, return_counts=True)
    return order[count[inverse] > 1]


def link_block(
    problem: NavigationProblem,
    link: Link,
    ends: dict[str, VehicleVariables],
    rx: dict[str, Receiver],
    key_base: int,
    use_phase: bool,
    parameters: Parameters,
) -> GnssLink:
    """Differences rover - reference of code, phase and Doppler. Raises InputError when the two share nothing."""
    ref, rov = rx[link.reference], rx[link.rover]
    a, b = ref.antenna, rov.antenna
    pairs = pair_rows(a.stream, b.stream, ref.usable, rov.usable, problem.settings.bands)
    grid = ends[link.rover].t_s
    inside = (b.stream.t_s[pairs.epoch] >= grid[0] - 0.01) & (b.stream.t_s[pairs.epoch] <= grid[-1] + 0.01)
    if not np.any(inside):
        raise InputError(_nothing_shared(link, a, b, bool(len(pairs.a))))
    arcs, arc = _phase_arcs(problem, a, b, pairs, inside & use_phase)
    row, kind, z, sigma = _differences(ref, rov, pairs, inside, arc)
    # one clock per kind, signal pair and constellation: the signal pair's name begins with the constellation
    order = np.lexsort((b.stream.sat[pairs.b[row]], pairs.group[row], kind, pairs.epoch[row]))
    order = _without_singles(order, (pairs.epoch[row] * 3 + kind) * len(pairs.group_names) + pairs.group[row])
    row, kind, z, sigma = row[order], kind[order], z[order], sigma[order]
    ra, rb = pairs.a[row], pairs.b[row]
    _, factor_of = np.unique(pairs.epoch[row], return_inverse=True)
    first = CommonGroups.from_labels(factor_of).start
    t_rover, t_ref = rov.prepared.t_s[rb[first]], ref.prepared.t_s[ra[first]]
    rows = _gnss_rows(
        kind,
        pairs.group[row],
        factor_of,
        t_rover[factor_of],
        sigma,
        label=list(b.stream.satellites),
        label_index=b.stream.sat[rb],
        source=f"{link.reference}-{link.rover}",
        group=list(pairs.group_names),
        azimuth_rad=rov.prepared.azimuth_rad[rb],
        elevation_rad=rov.prepared.elevation_rad[rb],
    )
    arc_row = np.full(len(row), -1, np.int64)
    arc_row[kind == PHASE] = np.unique(arc[row][kind == PHASE], return_inverse=True)[1]
    rover = antenna_end(ends[link.rover], t_rover, rov, parameters)
    reference = antenna_end(ends[link.reference], t_ref, ref, parameters)
    block = GnssBlock(
        rows,
        rover=rover,
        reference=reference,
        point_rover=factor_of,
        z=z,
        sat_rover=rov.prepared.sat_n[rb],
        vel_rover=np.nan_to_num(rov.prepared.sat_vel_n[rb]),
        sat_reference=ref.prepared.sat_n[ra],
        vel_reference=np.nan_to_num(ref.prepared.sat_vel_n[ra]),
        wavelength_m=b.stream.wavelength_m[rb],
        arc=arc_row,
        place_n=None if ref.vehicle.is_fixed else reference.vehicle.points(reference.query).r_n,
    )
    none = np.zeros(0)
    data = GnssLink(link, block, ra, rb, none.astype(np.int64), [], [], none, none, slips=arcs.slips, key_base=key_base)
    describe_arcs(data)
    return data


def antenna_end(end: VehicleVariables, t: Array, rx: Receiver, parameters: Parameters) -> Endpoint:
    """Where a receiver observes."""
    return sensor_end(end, t, rx.lever_b, f"{rx.vehicle.name}/gnss", rx.antenna.calibration, parameters)


def _nothing_shared(link: Link, a: Antenna, b: Antenna, have_rows: bool) -> str:
    common = set(a.stream.satellites) & set(b.stream.satellites)
    what = (
        "no common satellites"
        if not common
        else "no common usable observations inside the flight"
        if have_rows
        else "no common epochs"
    )
    spans = [f"{name} {x.stream.t_s[0]:.1f} to {x.stream.t_s[-1]:.1f} s" for name, x in ((link.reference, a), (link.rover, b))]
    return f"link {link.reference}-{link.rover}: {what} ({', '.join(spans)} after t0); check that the files are of one flight"


def _phase_arcs(
    problem: NavigationProblem, a: Antenna, b: Antenna, pairs: PairedRows, wanted: BoolArray
) -> tuple[Arcs, IntArray]:
    """Arcs of the paired rows, and per row its arc or -1 where the phase is missing, unfit for integers or the arc too short."""
    settings = problem.settings.ambiguity
    glonass = np.char.startswith(np.array(b.stream.satellites)[b.stream.sat[pairs.b]], "R")
    half_cycle = ((a.stream.lli[pairs.a] | b.stream.lli[pairs.b]) & 2) > 0
    finite = np.isfinite(a.stream.phase_cyc[pairs.a]) & np.isfinite(b.stream.phase_cyc[pairs.b])
    arcs = find_arcs(a.stream, b.stream, pairs, finite & ~glonass & ~half_cycle & wanted, settings)
    length = np.bincount(arcs.of_row[arcs.of_row >= 0], minlength=arcs.count + 1)
    return arcs, np.where((arcs.of_row >= 0) & (length[arcs.of_row] >= settings.min_arc_epochs), arcs.of_row, -1)


def _differences(
    ref: Receiver, rov: Receiver, pairs: PairedRows, inside: BoolArray, arc: IntArray
) -> tuple[IntArray, IntArray, Array, Array]:
    """Paired row, kind, difference and standard deviation of every usable observation, kinds one after the other."""
    ra, rb = pairs.a, pairs.b
    na, nb = ref.antenna.noise, rov.antenna.noise
    scale_a = elevation_scale(ref.prepared.elevation_rad[ra], na.elevation)
    scale_b = elevation_scale(rov.prepared.elevation_rad[rb], nb.elevation)
    moving = np.all(np.isfinite(rov.prepared.sat_vel_n[rb]), axis=1)
    parts = []
    for kind, sigma_a, sigma_b in (
        (CODE, na.code_m, nb.code_m),
        (PHASE, na.phase_m, nb.phase_m),
        (DOPPLER, na.doppler_mps, nb.doppler_mps),
    ):
        z = _difference(ref, rov, kind, ra, rb)
        use = np.flatnonzero(arc >= 0 if kind == PHASE else inside & np.isfinite(z) & (moving | (kind == CODE)))
        parts.append((use, np.full(len(use), kind), z[use], np.hypot(sigma_a * scale_a, sigma_b * scale_b)[use]))
    row, kinds, z, sigma = (np.concatenate(column) for column in zip(*parts, strict=True))
    return row, kinds, z, sigma


def _difference(ref: Receiver, rov: Receiver, kind: int, ra: IntArray, rb: IntArray) -> Array:
    """Rover minus reference (n,) of one kind for rows of the two."""
    name = {CODE: "code_m", PHASE: "phase_m", DOPPLER: "rate_mps"}[kind]
    return np.asarray(getattr(rov.differenced, name)[rb] - getattr(ref.differenced, name)[ra])


def correct_again(
    problem: NavigationProblem, data: GnssLink, rx: dict[str, Receiver], ends: dict[str, VehicleVariables]
) -> float:
    """Correct a link's rows where the trajectories put the antennas now; returns the largest change [m].

    Single points of rover and reference, which the first correction uses, differ by metres in height; the tropospheres
    then differ by millimetres, and the height of the baseline by three times that.
    """
    ref, rov = (_receiver_at(problem, rx[name], ends[name]) for name in (data.link.reference, data.link.rover))
    block = data.block
    z = block.z.copy()
    for kind in (CODE, PHASE):
        mine = np.flatnonzero(block.rows.kind == kind)
        z[mine] = _difference(ref, rov, kind, data.row_reference[mine], data.row_rover[mine])
    change = float(np.abs(z - block.z).max())
    block.z = z
    return change


def _receiver_at(problem: NavigationProblem, rx: Receiver, vehicle: VehicleVariables) -> Receiver:
    """A receiver corrected at its antenna's current positions."""
    if vehicle.mode == "fixed":
        return rx
    antenna = vehicle.r if vehicle.mode == "motion" else vehicle.r + vehicle.R @ np.asarray(rx.lever_b)
    r_n = interpolate(rx.antenna.stream.t_s, vehicle.t_s, antenna)
    return corrected(problem, rx.vehicle, rx.point, rx.clock_s, r_n)


def describe_arcs(data: GnssLink) -> None:
    """Fill the arc tables of a link from its block's rows, with a fresh float variable for every arc."""
    block = data.block
    n = int(block.arc.max()) + 1 if len(block.arc) else 0
    rows = np.flatnonzero(block.arc >= 0)
    first, last = np.zeros(n, np.int64), np.zeros(n, np.int64)
    last[block.arc[rows]] = rows
    first[block.arc[rows[::-1]]] = rows[::-1]
    data.arc_group = block.rows.group_index[first]
    data.arc_satellite = [block.rows.label[i] for i in block.rows.label_index[first]]
    data.arc_signal = [block.rows.group[g] for g in data.arc_group]
    data.arc_start_s, data.arc_end_s = block.rows.t_s[first], block.rows.t_s[last]
    block.amb_key = np.array([gtsam.symbol("a", data.key_base + i) for i in range(n)], np.int64)
    block.amb_value = np.zeros(n)
    data.state = ["float"] * n


def absolute_block(
    problem: NavigationProblem, end: VehicleVariables, rx: Receiver, parameters: Parameters
) -> GnssBlock | None:
    """Undifferenced code (one signal per satellite) and Doppler of a moving receiver."""
    antenna = rx.antenna
    stream, noise = antenna.stream, antenna.noise
    grid = end.t_s
    rows = one_code_per_satellite(stream, rx.usable)
    t = rx.prepared.t_s[rows]
    rows = rows[(t >= grid[0] - 0.01) & (t <= grid[-1] + 0.01)]
    rate_ok = np.isfinite(rx.prepared.rate_mps[rows]) & np.all(np.isfinite(rx.prepared.sat_vel_n[rows]), axis=1)
    parts = [
        (rows, np.full(len(rows), CODE), rx.prepared.code_m[rows]),
        (rows[rate_ok], np.full(int(rate_ok.sum()), DOPPLER), rx.prepared.rate_mps[rows[rate_ok]]),
    ]
    row, kind, z = (np.concatenate([p[i] for p in parts]) for i in range(3))
    letters, system = np.unique(system_of(stream)[row], return_inverse=True)
    order = np.lexsort((stream.sat[row], system, kind, stream.epoch[row]))
    order = _without_singles(order, (stream.epoch[row] * 3 + kind) * max(len(letters), 1) + system)
    row, kind, z, system = row[order], kind[order], z[order], system[order]
    if not len(row):
        return None
    interval = float(np.median(np.diff(stream.t_s))) if len(stream.t_s) > 1 else 1.0
    persist = np.sqrt(max(1.0, noise.absolute_correlation_s / interval))
    scale = elevation_scale(rx.prepared.elevation_rad[row], noise.elevation)
    sigma = np.where(kind == CODE, noise.absolute_code_m * persist, noise.doppler_mps) * scale
    _, factor_of = np.unique(stream.epoch[row], return_inverse=True)
    first = np.concatenate([[0], np.flatnonzero(np.diff(factor_of)) + 1])
    times = rx.prepared.t_s[row[first]]
    table = _gnss_rows(
        kind,
        system,
        factor_of,
        times[factor_of],
        sigma,
        label=list(stream.satellites),
        label_index=stream.sat[row],
        source=end.name,
        group=[str(s) for s in letters],
        azimuth_rad=rx.prepared.azimuth_rad[row],
        elevation_rad=rx.prepared.elevation_rad[row],
    )
    zero = np.zeros((len(row), 3))
    return GnssBlock(
        table,
        rover=antenna_end(end, times, rx, parameters),
        reference=None,
        point_rover=factor_of,
        z=z,
        sat_rover=rx.prepared.sat_n[row],
        vel_rover=np.nan_to_num(rx.prepared.sat_vel_n[row]),
        sat_reference=zero,
        vel_reference=zero,
        wavelength_m=stream.wavelength_m[row],
        arc=np.full(len(row), -1, np.int64),
    )


def position_blocks(end: VehicleVariables, parameters: Parameters) -> list[Block]:
    """Position fixes and heights of a vehicle."""
    vehicle = end.vehicle
    blocks: list[Block] = []
    for p in vehicle.positions:
        ok = in_grid(p.t_s, end.t_s, p.calibration.time_s) & np.all(np.isfinite(p.r_n), axis=1) & end.is_carried(p.t_s)
        n = int(ok.sum())
        if n:
            rows = plain_rows(
                POSITION,
                np.repeat(p.t_s[ok], 3),
                p.sigma_m[ok].ravel(),
                np.repeat(np.arange(n), 3),
                f"{vehicle.name}/{p.name}",
                ["E", "N", "U"],
                np.tile(np.arange(3), n),
            )
            at = sensor_end(end, p.t_s[ok], p.lever_b, f"{vehicle.name}/{p.name}", p.calibration, parameters)
            blocks.append(PositionBlock(rows, end=at, z_n=p.r_n[ok]))
    for h in vehicle.heights:
        ok = in_grid(h.t_s, end.t_s, h.calibration.time_s) & np.isfinite(h.up_m) & end.is_carried(h.t_s)
        n = int(ok.sum())
        if n:
            name = f"{vehicle.name}/{h.name}"
            at = sensor_end(end, h.t_s[ok], h.lever_b, name, h.calibration, parameters)
            rows = plain_rows(HEIGHT, h.t_s[ok], h.sigma_m[ok], at.query.k, name, ["U"], np.zeros(n, np.int64))
            bias = parameters.scalar(f"{name} bias", "m", h.calibration.bias)
            blocks.append(HeightBlock(rows, end=at, z_m=h.up_m[ok], bias=bias))
    return blocks


def range_blocks(model: RangeModel, ends: dict[str, VehicleVariables], parameters: Parameters) -> list[RangeBlock]:
    """A block per pair of carriers (vehicle-vehicle or vehicle-anchor), per pair of tags where these have parameters."""
    stream = model.stream
    tags = stream.tags
    blocks: list[RangeBlock] = []
    by_tag = model.per_pair or model.lever_sigma_m > 0
    carrier = np.array([tag.vehicle or "" for tag in tags])
    grid = next(iter(ends.values())).t_s
    # the first end is always on a vehicle
    swap = carrier[stream.tag_a] == ""
    a, b = np.where(swap, stream.tag_b, stream.tag_a), np.where(swap, stream.tag_a, stream.tag_b)
    ok = in_grid(stream.t_s, grid, model.time_sigma_s) & np.isfinite(stream.range_m) & (carrier[a] != carrier[b])
    lever = np.array([tag.lever_b for tag in tags])
    anchor = np.array([tag.position_n or (np.nan,) * 3 for tag in tags])
    name_of = np.array([tag.name for tag in tags]) if by_tag else carrier
    first, second = np.minimum(a, b) if by_tag else a, np.maximum(a, b) if by_tag else b
    pair = np.char.add(np.char.add(name_of[first], "\n"), name_of[second])
    for name, end in ends.items():
        ok &= ((carrier[a] != name) & (carrier[b] != name)) | end.is_carried(stream.t_s)
    for name in np.unique(pair[ok]):
        rows = np.flatnonzero(ok & (pair == name))
        va, vb = str(carrier[a[rows[0]]]), str(carrier[b[rows[0]]])
        if by_tag:  # both directions of a pair of tags
            flip = a[rows] != a[rows[0]]
            ta, tb = np.where(flip, b[rows], a[rows]), np.where(flip, a[rows], b[rows])
        else:
            ta, tb = a[rows], b[rows]
        t = stream.t_s[rows]
        labels, index = np.unique([f"{tags[i].name}-{tags[j].name}" for i, j in zip(ta, tb, strict=True)], return_inverse=True)
        offset = time_offset(parameters.scalar(f"{stream.name} time offset", "s", model.time_sigma_s))
        tag_end = _ranged(ends[va], t, lever[ta], tags[ta[0]], model, parameters, offset)
        other = _ranged(ends[vb], t, lever[tb], tags[tb[0]], model, parameters, offset) if vb else None
        interval = tag_end.query.k if other is None else tag_end.query.k * len(grid) + other.query.k
        source = f"{stream.name} {va}-{vb or 'anchors'}"
        what = f"{stream.name} {tags[ta[0]].name}-{tags[tb[0]].name}" if model.per_pair else stream.name
        blocks.append(
            RangeBlock(
                plain_rows(RANGE, t, stream.sigma_m[rows], interval, source, [str(s) for s in labels], index),
                a=tag_end,
                b=other,
                anchor_n=None if other is not None else anchor[tb],
                z_m=stream.range_m[rows],
                parameter=_range_parameter(model, what, parameters),
            )
        )
    return blocks


def _range_parameter(model: RangeModel, what: str, parameters: Parameters) -> Parameter | None:
    """Bias and scale of ranges; what is not estimated is held by its prior."""
    if model.bias_sigma_m == 0 and model.scale_sigma == 0:
        return None
    sigma = np.array([max(model.bias_sigma_m, HELD), max(model.scale_sigma, 1e-3 * HELD)])
    return parameters.add(what, ("bias", "scale"), "m", np.zeros(2), sigma)


def _ranged(
    end: VehicleVariables, t: Array, lever: Array, tag: Tag, model: RangeModel, parameters: Parameters, offset: list[Offset]
) -> Endpoint:
    """One end of ranges: a tag carried by a vehicle."""
    correction = parameters.vector(f"{model.stream.name} {tag.name} lever arm", "m", model.lever_sigma_m)
    lever_of = correction if end.mode == "imu" else None
    return Endpoint(end, end.query(t, lever), lever_of, [replace(o) for o in offset])


def motion_block(vehicle: VehicleVariables) -> MotionBlock:
    L, J = motion_prior_rows(vehicle)
    n = len(L)
    rows = plain_rows(
        -1,
        np.repeat(vehicle.t_s[1:], 6),
        np.ones(6 * n),
        np.repeat(np.arange(n), 6),
        vehicle.name,
        ["motion"],
        np.zeros(6 * n, np.int64),
    )
    return MotionBlock(rows, vehicle=vehicle, keys_of=[motion_keys(vehicle, k) for k in range(n)], L=L, J0=J)


def joint_block(a: VehicleVariables, b: VehicleVariables) -> JointBlock:
    """Rows without information that keep two vehicles' states of one time in one clique, so that their covariance is at hand."""
    n = len(a.t_s)
    rows = plain_rows(-1, a.t_s, np.ones(n), np.arange(n), f"{a.name}-{b.name}", ["joint"], np.zeros(n, np.int64))
    return JointBlock(rows, a=a, b=b)


def add_ionosphere(problem: NavigationProblem, data: GnssLink, baseline_m: float) -> IonosphereBlock | None:
    """Give a long link's code and phase rows a differential ionosphere per satellite and time step.

    Vertical at L1, scaled by the obliquity 1 + 16 (0.53 - el)^3 (el in semicircles) and (lambda / lambda_L1)^2, with plus
    sign for code and minus for phase. Source: IS-GPS-200, 20.3.3.5.2.5, for the obliquity.
    """
    settings, block = problem.settings, data.block
    if settings.ionosphere_ppm == 0 or baseline_m < settings.ionosphere_min_baseline_m:
        return None
    rows = block.rows
    sign = np.select([rows.kind == CODE, rows.kind == PHASE], [1.0, -1.0], 0.0)
    obliquity = 1 + 16 * (0.53 - rows.elevation_rad / np.pi) ** 3
    step = np.floor((rows.t_s - rows.t_s[0]) / settings.ionosphere_step_s).astype(np.int64)
    label = rows.label_index * (int(step.max()) + 1) + step
    used, index = np.unique(label[sign != 0], return_inverse=True)
    block.iono = np.full(block.n, -1, np.int64)
    block.iono[sign != 0] = index
    block.iono_scale = sign * obliquity * (block.wavelength_m / WAVELENGTH_L1_M) ** 2
    block.iono_key = np.array([gtsam.symbol("i", data.key_base + k) for k in range(len(used))], np.int64)
    block.iono_value = np.zeros(len(used))
    sat, at = used // (int(step.max()) + 1), used % (int(step.max()) + 1)
    follows = np.concatenate([[False], sat[1:] == sat[:-1]])
    sigma = settings.ionosphere_ppm * 1e-6 * baseline_m
    gap_s = np.concatenate([[0], np.diff(at)]) * settings.ionosphere_step_s
    sigmas = np.where(follows, sigma * np.sqrt(np.maximum(gap_s, 1.0) / settings.ionosphere_correlation_s), sigma)
    n = len(used)
    table = plain_rows(
        -1,
        rows.t_s[0] + at * settings.ionosphere_step_s,
        sigmas,
        np.arange(n),
        rows.source,
        ["ionosphere"],
        np.zeros(n, np.int64),
    )
    return IonosphereBlock(table, of=block, previous=np.where(follows, np.arange(n) - 1, -1))


@dataclass(slots=True)
class Built:
    """A graph with the parts that the ambiguity resolution and the solution refer to."""

    graph: Graph
    links: list[GnssLink]
    receivers: dict[str, Receiver]
    ends: dict[str, VehicleVariables]


def native_factors(graph: Graph) -> None:
    """(Re)build the native factors: IMU at the current bias, priors, parameter priors."""
    graph.native = gtsam.NonlinearFactorGraph()
    for v in graph.vehicles:
        if v.mode == "imu":
            add_imu_factors(graph.native, v)
        add_priors(graph.native, v, HINT_SIGMA_RAD if v.vehicle.heading_hint_rad is not None else HEADING_SIGMA_RAD)
    graph.native.push_back(graph.parameters.priors())


def build(
    problem: NavigationProblem,
    vehicles: list[VehicleVariables],
    rx: dict[str, Receiver],
    use_phase: bool,
    progress: Callable[[float], None] = lambda f: None,
) -> Built:
    """All blocks and native factors for variables that already hold start values."""
    ends = {v.name: v for v in vehicles}
    graph = Graph(vehicles, [], gtsam.NonlinearFactorGraph())
    for end in vehicles:
        if end.mode == "imu":
            end.imu_offset = graph.parameters.scalar(f"{end.name}/imu time offset", "s", end.vehicle.imu_calibration.time_s)
    links: list[GnssLink] = []
    rovers = {link.rover for link in problem.links}
    key_base = 0
    absolute: list[Block] = []
    for link in problem.links:
        if link.reference in rx and link.rover in rx:
            data = link_block(problem, link, ends, rx, key_base, use_phase, graph.parameters)
            key_base += 1_000_000
            links.append(data)
            graph.gnss.append(data.block)
            apart = float(np.linalg.norm(ends[link.rover].r - ends[link.reference].r, axis=1).max())
            ionosphere = add_ionosphere(problem, data, apart) if use_phase else None
            if ionosphere is not None:
                absolute.append(ionosphere)
    for v in problem.vehicles:
        if v.name in rx and v.name not in rovers and not v.is_fixed and problem.settings.use_absolute and not v.positions:
            block = absolute_block(problem, ends[v.name], rx[v.name], graph.parameters)
            if block is not None:
                absolute.append(block)
    others: list[Block] = []
    for model in problem.ranges:
        others += range_blocks(model, ends, graph.parameters)
    for end in vehicles:
        others += position_blocks(end, graph.parameters)
        if end.mode == "motion":
            others.append(motion_block(end))
    for pair in problem.wanted_pairs:
        both = [ends[pair.reference], ends[pair.rover]]
        if all(end.mode != "fixed" for end in both):
            graph.joints.append(joint_block(both[0], both[1]))
    graph.blocks = [*graph.gnss, *absolute, *others]
    progress(0.5)
    native_factors(graph)
    progress(1.0)
    return Built(graph, links, rx, ends)
