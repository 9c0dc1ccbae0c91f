"""From a navigation problem to blocks: receivers prepared, rows sorted into blocks, factors between states.

The absolute code of a rover is not used where its link's reference has absolute information of its own: undifferenced
code of the reference and differences carry everything once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from factorgraph.assembly.atmosphere import absolute_codes, link_atmosphere, receiver_atmosphere
from factorgraph.assembly.barometer import barometer_blocks
from factorgraph.assembly.blocks import (
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
    JointBlock,
    Offset,
    PositionBlock,
    RangeBlock,
    Rows,
    interval_of,
)
from factorgraph.assembly.constraints import constraint_blocks
from factorgraph.assembly.engine import Engine
from factorgraph.assembly.inertial_block import imu_block
from factorgraph.assembly.intersystem import biases, shared_clocks, start_biases
from factorgraph.assembly.keys import symbol
from factorgraph.assembly.optimizer import Graph
from factorgraph.assembly.parameters import Parameters
from factorgraph.assembly.priors import motion_block, parameter_priors, state_prior
from factorgraph.assembly.rows import in_grid, plain_rows, sensor_end, time_offset
from factorgraph.assembly.sensors import sensor_blocks
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.errors import InputError
from factorgraph.measurements import Tag
from factorgraph.models.arcs import Arcs, find_arcs
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.gnss import (
    PairedRows,
    elevation_scale,
    pair_rows,
    system_of,
)
from factorgraph.models.receivers import Quantity, Receiver, corrected, difference_sigma
from factorgraph.problem import Antenna, Link, NavigationProblem, RangeModel
from factorgraph.sampling import interpolate
from factorgraph.solution import ParameterEstimate
from factorgraph.types import Array, BoolArray, IntArray


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
    key_base: int = 0
    float_cyc: Array = field(default_factory=lambda: np.zeros(0))  # before fixing
    float_sigma: Array = field(default_factory=lambda: np.zeros(0))
    cause: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (n,) why a row begins an arc: arcs.CAUSES, -1
    half: BoolArray = field(default_factory=lambda: np.zeros(0, bool))  # (n,) flagged as ambiguous by half a cycle
    odd: BoolArray = field(default_factory=lambda: np.zeros(0, bool))  # (n,) of an arc known to be whole in half cycles only
    repairs: dict[int, float] = field(default_factory=dict)  # row that goes on over a slip -> sigma of its size [cyc]

    def has_integer(self, arc: int) -> bool:
        """GLONASS satellites have carriers of their own and with them delays of receivers, which no difference cancels."""
        return self.arc_satellite[arc][0] != "R"

    def make_free(self, arc: int) -> None:
        """Give an arc its variable back."""
        self.block.amb_key[arc] = symbol("a", self.key_base + arc)


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
    cn0_dbhz: Array,
    clock_index: IntArray,
) -> Rows:
    """Rows already sorted by factor, kind, clock, group."""
    clocks = CommonGroups.from_labels((factor * 3 + kind) * (int(clock_index.max(initial=0)) + 1) + clock_index)
    factors = CommonGroups.from_labels(factor)
    place = (azimuth_rad, elevation_rad)
    return Rows(kind, t_s, sigma, factors, clocks, source, label, label_index, group, group_index, *place, cn0_dbhz=cn0_dbhz)


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
    arcs = _phase_arcs(problem, a, b, pairs, inside & use_phase)
    row, kind, z, sigma = _differences(ref, rov, pairs, inside, arcs.of_row)
    # one clock per kind, signal pair and constellation: the signal pair's name begins with the constellation
    shared = problem.settings.inter_system == "constant"
    group, names = pairs.group[row], pairs.group_names
    clock = shared_clocks(kind, group, names, b.stream.wavelength_m[pairs.b[row]]) if shared else group
    order = np.lexsort((b.stream.sat[pairs.b[row]], group, clock, kind, pairs.epoch[row]))
    order = _without_singles(order, (pairs.epoch[row] * 3 + kind) * len(names) + clock)
    row, kind, z, sigma, clock = row[order], kind[order], z[order], sigma[order], clock[order]
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
        cn0_dbhz=np.fmin(a.stream.cn0_dbhz[ra], b.stream.cn0_dbhz[rb]),
        clock_index=clock,
    )
    constant, bias_of = biases(kind, pairs.group[row], clock, names, rows.source, parameters) if shared else ([], clock)
    arc_row = np.full(len(row), -1, np.int64)
    arc_row[kind == PHASE] = np.unique(arcs.of_row[row][kind == PHASE], return_inverse=True)[1]
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
        biases=constant,
        bias_of=bias_of,
        clock_index=clock,
    )
    none = np.zeros(0)
    data = GnssLink(link, block, ra, rb, none.astype(np.int64), [], [], none, none, key_base=key_base)
    data.cause, data.half = np.where(kind == PHASE, arcs.cause[row], -1), arcs.half[row]
    data.odd = np.zeros(len(row), bool)
    describe_arcs(data)
    start_biases(block)
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


def _phase_arcs(problem: NavigationProblem, a: Antenna, b: Antenna, pairs: PairedRows, wanted: BoolArray) -> Arcs:
    """Arcs of the paired rows, of any length."""
    finite = np.isfinite(a.stream.phase_cyc[pairs.a]) & np.isfinite(b.stream.phase_cyc[pairs.b])
    return find_arcs(a.stream, b.stream, pairs, finite & wanted, problem.settings.ambiguity)


def _differences(
    ref: Receiver, rov: Receiver, pairs: PairedRows, inside: BoolArray, arc: IntArray
) -> tuple[IntArray, IntArray, Array, Array]:
    """Paired row, kind, difference and standard deviation of every usable observation, kinds one after the other."""
    ra, rb = pairs.a, pairs.b
    moving = np.all(np.isfinite(rov.prepared.sat_vel_n[rb]), axis=1)
    parts = []
    quantities: dict[int, Quantity] = {CODE: "code_m", PHASE: "phase_m", DOPPLER: "doppler_mps"}
    for kind, quantity in quantities.items():
        z = _difference(ref, rov, kind, ra, rb)
        use = np.flatnonzero(arc >= 0 if kind == PHASE else inside & np.isfinite(z) & (moving | (kind == CODE)))
        parts.append((use, np.full(len(use), kind), z[use], difference_sigma(quantity, ref, rov, ra, rb)[use]))
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
    block.amb_key = np.array([symbol("a", data.key_base + i) for i in range(n)], np.int64)
    block.amb_value, block.amb_unit_cyc = np.zeros(n), np.ones(n)
    data.state, data.float_cyc, data.float_sigma = ["float"] * n, np.zeros(0), np.zeros(0)


def absolute_block(problem: NavigationProblem, end: VehicleVariables, rx: Receiver, parameters: Parameters) -> GnssBlock | None:
    """Undifferenced code (one signal per satellite) and Doppler of a moving receiver."""
    antenna = rx.antenna
    stream, noise = antenna.stream, antenna.noise
    grid = end.t_s
    rows, code, noisier = absolute_codes(problem.settings, rx)
    t = rx.prepared.t_s[rows]
    inside = (t >= grid[0] - 0.01) & (t <= grid[-1] + 0.01)
    rows, code, noisier = rows[inside], code[inside], noisier[inside]
    rate_ok = np.isfinite(rx.prepared.rate_mps[rows]) & np.all(np.isfinite(rx.prepared.sat_vel_n[rows]), axis=1)
    parts = [
        (rows, np.full(len(rows), CODE), code, noisier),
        (rows[rate_ok], np.full(int(rate_ok.sum()), DOPPLER), rx.prepared.rate_mps[rows[rate_ok]], np.ones(int(rate_ok.sum()))),
    ]
    row, kind, z, noisier = (np.concatenate([p[i] for p in parts]) for i in range(4))
    letters, system = np.unique(system_of(stream)[row], return_inverse=True)
    shared = problem.settings.inter_system == "constant"
    clock = np.zeros_like(system) if shared else system
    order = np.lexsort((stream.sat[row], system, clock, kind, stream.epoch[row]))
    order = _without_singles(order, (stream.epoch[row] * 3 + kind) * max(len(letters), 1) + clock)
    row, kind, z, system, clock = row[order], kind[order], z[order], system[order], clock[order]
    noisier = noisier[order]
    if not len(row):
        return None
    interval = float(np.median(np.diff(stream.t_s))) if len(stream.t_s) > 1 else 1.0
    persist = np.sqrt(max(1.0, noise.absolute_correlation_s / interval))
    scale = elevation_scale(rx.prepared.elevation_rad[row], noise.elevation)
    persistence = np.where(kind == CODE, persist, 1.0)
    # what a combination amplifies is the code's own noise, not what persists
    own_code = np.hypot(noise.absolute_code_m, noise.code_m * np.sqrt(noisier**2 - 1))
    sigma = np.where(kind == CODE, own_code, noise.doppler_mps) * scale * persistence
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
        cn0_dbhz=stream.cn0_dbhz[row],
        clock_index=clock,
    )
    constant, bias_of = biases(kind, system, clock, letters.tolist(), end.name, parameters) if shared else ([], clock)
    table.persistence = persistence
    zero = np.zeros((len(row), 3))
    block = GnssBlock(
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
        biases=constant,
        bias_of=bias_of,
        clock_index=clock,
    )
    start_biases(block)
    return block


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
    for i, h in enumerate(vehicle.heights):
        ok = in_grid(h.t_s, end.t_s, h.calibration.time_s) & np.isfinite(h.up_m) & end.is_carried(h.t_s)
        n = int(ok.sum())
        if n and h.calibration.bias_walk > 0:
            blocks += barometer_blocks(end, h, ok, i, parameters)
        elif n:
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
        interval = interval_of([tag_end] if other is None else [tag_end, other])
        source = f"{stream.name} {va}-{vb or 'anchors'}"
        what = f"{stream.name} {tags[ta[0]].name}-{tags[tb[0]].name}" if model.per_pair else stream.name
        blocks.append(
            RangeBlock(
                plain_rows(RANGE, t, stream.sigma_m[rows], interval, source, [str(s) for s in labels], index),
                a=tag_end,
                b=other,
                anchor_n=None if other is not None else anchor[tb],
                z_m=stream.range_m[rows],
                bias=parameters.scalar(f"{what} bias", "m", model.bias_sigma_m),
                scale=parameters.scalar(f"{what} scale", "1", model.scale_sigma),
            )
        )
    return blocks


def _ranged(
    end: VehicleVariables, t: Array, lever: Array, tag: Tag, model: RangeModel, parameters: Parameters, offset: list[Offset]
) -> Endpoint:
    """One end of ranges: a tag carried by a vehicle."""
    correction = parameters.vector(f"{model.stream.name} {tag.name} lever arm", "m", model.lever_sigma_m)
    lever_of = correction if end.mode == "imu" else None
    return Endpoint(end, end.query(t, lever), lever_of, [replace(o) for o in offset])


def joint_blocks(pairs: Iterable[tuple[VehicleVariables, VehicleVariables]]) -> list[JointBlock]:
    """Rows without information that keep the states of one time in one clique, so that the covariance of pairs is at hand.

    One block per set of moving vehicles that pairs connect.
    """
    sets: list[dict[int, VehicleVariables]] = []
    for a, b in pairs:
        if a is not b and a.mode != "fixed" and b.mode != "fixed":
            met = [s for s in sets if a.index in s or b.index in s]
            sets = [s for s in sets if s not in met]
            sets.append({k: v for s in (*met, {a.index: a, b.index: b}) for k, v in s.items()})
    blocks = []
    for s in sets:
        vehicles = tuple(s.values())
        t, name = vehicles[0].t_s, "-".join(v.name for v in vehicles)
        rows = plain_rows(-1, t, np.ones(len(t)), np.arange(len(t)), name, ["joint"], np.zeros(len(t), np.int64))
        blocks.append(JointBlock(rows, vehicles=vehicles))
    return blocks


@dataclass(slots=True)
class Built:
    """A graph with the parts that the ambiguity resolution and the solution refer to."""

    graph: Graph
    links: list[GnssLink]
    receivers: dict[str, Receiver]
    ends: dict[str, VehicleVariables]  # carried antennas: the vehicle that carries them
    noise: list[ParameterEstimate] = field(default_factory=list)  # found from residuals


def build(
    problem: NavigationProblem,
    vehicles: list[VehicleVariables],
    rx: dict[str, Receiver],
    use_phase: bool,
    engine: Engine,
) -> Built:
    """All blocks for variables that already hold start values."""
    ends = {v.name: v for v in vehicles}
    antennas = ends | {v.name: ends[v.carrier] for v in problem.vehicles if v.carrier is not None}
    graph = Graph(vehicles, engine)
    for end in vehicles:
        end.preintegrated_bias = end.bias.copy()
        if end.mode == "imu":
            end.imu_offset = graph.parameters.scalar(f"{end.name}/imu time offset", "s", end.vehicle.imu_calibration.time_s)
    links: list[GnssLink] = []
    rovers = {link.rover for link in problem.links}
    key_base = 0
    absolute: list[Block] = []
    for link in problem.links:
        a, b = antennas[link.reference], antennas[link.rover]
        if link.reference in rx and link.rover in rx and (a is not b or a.mode == "imu"):
            data = link_block(problem, link, antennas, rx, key_base, use_phase, graph.parameters)
            key_base += 1_000_000
            links.append(data)
            graph.gnss.append(data.block)
            if use_phase:
                absolute += link_atmosphere(problem, data.block, data.key_base, a, b)
    for v in problem.vehicles:
        if v.name in rx and v.name not in rovers and not v.is_fixed and problem.settings.use_absolute and not v.positions:
            block = absolute_block(problem, antennas[v.name], rx[v.name], graph.parameters)
            if block is not None:
                absolute.append(block)
                if use_phase:
                    key_base += 1_000_000
                    absolute += receiver_atmosphere(problem, block, key_base, antennas[v.name])
    others: list[Block] = []
    for model in problem.ranges:
        others += range_blocks(model, ends, graph.parameters)
    for end in vehicles:
        others += position_blocks(end, graph.parameters)
        if end.mode == "motion":
            others.append(motion_block(end))
        inertial = imu_block(end, graph.parameters)
        if inertial is not None:
            others.append(inertial)
    others += sensor_blocks(problem, ends, graph.parameters)
    others += constraint_blocks(problem, ends, graph.parameters)
    graph.joints += joint_blocks((antennas[p.reference], antennas[p.rover]) for p in problem.wanted_pairs)
    starts = [prior for end in vehicles if (prior := state_prior(end)) is not None]
    graph.blocks = [*graph.gnss, *absolute, *others, *starts, *parameter_priors(graph.parameters)]
    return Built(graph, links, rx, antennas)
