"""The solution of a problem: trajectories with covariances, pairs, ambiguities, residuals, diagnostics."""

from __future__ import annotations

import dataclasses
import platform
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from factorgraph.assembly.blocks import CODE, CONSTRAINT, KINDS, Block, GnssBlock
from factorgraph.assembly.build import Built, GnssLink
from factorgraph.assembly.conditioned import EpochIntegers
from factorgraph.assembly.engine import Covariances
from factorgraph.assembly.optimizer import Graph, Result
from factorgraph.assembly.pairs import PairEnd, pair_covariance, pair_ends, pair_truth
from factorgraph.assembly.phases import slip_table
from factorgraph.assembly.remarks import gap_remarks, heading_notes, unplaced_notes, untold_notes
from factorgraph.assembly.variables import VehicleVariables
from factorgraph.attitude import quat_from_matrix
from factorgraph.models.differencing import CommonGroups
from factorgraph.models.outliers import classify
from factorgraph.problem import Link, NavigationProblem, Sensor
from factorgraph.solution import (
    ATT,
    BA,
    BG,
    POS,
    VEL,
    AmbiguityTable,
    Diagnostics,
    Fix,
    PairSolution,
    ParameterEstimate,
    ResidualTable,
    SlipTable,
    Solution,
    Status,
    VehicleSolution,
)
from factorgraph.types import Array, BoolArray, IntArray

FIXED_DIFFERENCES = 4  # double differences with integers that make an epoch fixed
BETWEEN_EPOCHS_S = 2.0  # a state between two epochs no further apart shares their status


def make_solution(
    problem: NavigationProblem,
    method: str,
    built: Built,
    result: Result,
    ratio: float,
    spent: dict[str, float],
    notes: list[str],
    integers: EpochIntegers | None = None,
) -> Solution:
    """Collect everything known after the optimisation; `integers`: as they were at each state time, not for the flight."""
    graph = built.graph
    eliminated = graph.eliminate(joints=True)
    cov = eliminated.covariances() if eliminated is not None else None
    vehicles = tuple(_vehicle(v, cov) for v in graph.vehicles)
    links = {(d.link.reference, d.link.rover): d for d in built.links}
    pairs = tuple(_pair(problem, p, built, cov, links, ratio) for p in problem.wanted_pairs)
    if integers is not None:
        pairs = tuple(integers.applied(p) for p in pairs)
    residuals = _residuals(graph, problem.settings.outlier_sigma)
    slips = slip_table(built.links)
    nis_t, nis, dof = _nis(graph, cov)
    told = [*untold_notes(list(graph.parameters), cov), *heading_notes(vehicles)]
    gap_notes, gap_warnings = gap_remarks(problem, graph.vehicles)
    return Solution(
        name=problem.name,
        method=method,
        t0=problem.t0,
        frame=problem.frame,
        vehicles=vehicles,
        pairs=pairs,
        ambiguities=_ambiguities(graph, built.links, cov),
        residuals=residuals,
        diagnostics=Diagnostics(
            status=result.status,
            n_iterations=max(len(result.costs) - 1, 0),
            cost=np.array(result.costs),
            runtime_s=dict(spent),
            nis_t_s=nis_t,
            nis=nis,
            nis_dof=dof,
            warnings=(*_warnings(problem, built, result.status, cov is None, pairs), *gap_warnings),
            notes=(*notes, *_clock_notes(built), *_slip_notes(built.links, slips), *gap_notes, *unplaced_notes(problem), *told),
            parameters=(*_parameters(graph, cov), *built.noise),
        ),
        configuration=configuration(problem),
        versions=versions(graph.engine.packages),
        slips=slips,
        carriers={v.name: v.carrier for v in problem.vehicles if v.carrier is not None},
    )


def versions(packages: tuple[str, ...]) -> dict[str, str]:
    """Versions of what computed the solution: this package, those of every method, and an engine's."""
    found = {"python": platform.python_version()}
    for name in ("relnav", *packages, "numpy", "scipy", "numba"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def configuration(problem: NavigationProblem) -> dict[str, object]:
    """The problem's choices as plain JSON types: everything but the measurements."""

    def plain(value: object) -> object:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        if isinstance(value, dict):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, (tuple, list)):
            return [plain(v) for v in value]
        return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)

    def sensor(stream: Sensor) -> object:
        lever = getattr(stream, "lever_b", None)
        return {"calibration": plain(stream.calibration)} | ({} if lever is None else {"lever_b": plain(lever)})

    return {
        "settings": plain(problem.settings),
        "vehicles": {
            v.name: {
                "fixed_n": plain(v.fixed_n),
                "imu_noise": plain(v.imu_noise) if v.imu is not None else None,
                "gnss_noise": plain(v.gnss.noise) if v.gnss is not None else None,
                "gnss_lever_b": plain(v.gnss.lever_b) if v.gnss is not None else None,
                "gnss_calibration": plain(v.gnss.calibration) if v.gnss is not None else None,
                "imu_calibration": plain(v.imu_calibration) if v.imu is not None else None,
                "constraints": plain(v.constraints),
                "carrier": v.carrier,
                "motion": plain(v.motion) if v.imu is None else None,
                "sensors": {s.name: sensor(s) for s in v.sensors},
            }
            for v in problem.vehicles
        },
        "links": [plain(link) for link in problem.links],
        "ranges": [
            {"name": m.stream.name} | {f.name: getattr(m, f.name) for f in dataclasses.fields(m) if f.name != "stream"}
            for m in problem.ranges
        ],
        "visions": {s.name: {"calibration": plain(s.calibration)} for s in problem.visions},
    }


def _state_map(v: VehicleVariables, k: int) -> Array:
    """d(position, velocity, attitude, gyro bias, accel bias errors) / d(local columns), (15, w)."""
    if v.mode == "motion":
        T = np.zeros((15, 6))
        T[POS, :3], T[VEL, 3:] = np.eye(3), np.eye(3)
        return T
    T = np.zeros((15, 15))
    R = v.R[k]
    T[POS, 3:6], T[VEL, 6:9], T[ATT, 0:3] = R, np.eye(3), -R
    T[BA, 9:12], T[BG, 12:15] = np.eye(3), np.eye(3)
    return T


def state_covariances(v: VehicleVariables, cov: Covariances) -> Array:
    """Covariances (K, 15, 15) of a moving vehicle's states; NaN where not estimated."""
    K, n = len(v.t_s), 15 if v.mode == "imu" else 6
    P = np.full((K, 15, 15), np.nan)
    T = np.array([_state_map(v, k)[:n] for k in range(K)])
    P[:, :n, :n] = T @ cov.joints([v.keys(k) for k in range(K)]) @ np.swapaxes(T, 1, 2)
    return P


def _vehicle(v: VehicleVariables, cov: Covariances | None) -> VehicleSolution:
    K = len(v.t_s)
    P = np.full((K, 15, 15), np.nan)
    nan3 = np.full((K, 3), np.nan)
    if v.mode == "fixed":
        P[:, :6, :6] = 0.0
        return VehicleSolution(v.name, v.t_s, v.r, v.v, np.full((K, 4), np.nan), nan3, nan3, P, v.vehicle.truth, True)
    if cov is not None:
        P = state_covariances(v, cov)
    if v.mode == "imu":
        return VehicleSolution(v.name, v.t_s, v.r, v.v, quat_from_matrix(v.R), v.bias[:, :3], v.bias[:, 3:], P, v.vehicle.truth)
    return VehicleSolution(v.name, v.t_s, v.r, v.v, np.full((K, 4), np.nan), nan3, nan3, P, v.vehicle.truth)


def _pair(
    problem: NavigationProblem,
    pair: Link,
    built: Built,
    cov: Covariances | None,
    links: dict[tuple[str, str], GnssLink],
    ratio: float,
) -> PairSolution:
    a, b = both = pair_ends(problem, built.graph.vehicles, pair)
    (r_a, v_a), (r_b, v_b) = a.motion(), b.motion()
    t_s = a.vehicle.t_s
    K = len(t_s)
    C = problem.frame.C_to_enu(r_a)  # n -> east-north-up at the reference
    P = pair_covariance(problem, both, cov) if cov is not None else np.full((K, 6, 6), np.nan)
    fix, n_sat, ratios = _pair_fix(pair, links, built.ends, K, ratio)
    truth, truth_v = pair_truth(both, C)
    return PairSolution(
        pair.reference,
        pair.rover,
        t_s,
        np.einsum("kij,kj->ki", C, r_b - r_a),
        np.einsum("kij,kj->ki", C, v_b - v_a),
        P,
        fix,
        ratios,
        n_sat,
        truth,
        truth_v,
        *(_lever(end) for end in both),
    )


def _lever(end: PairEnd) -> tuple[float, float, float]:
    x, y, z = end.lever_b.tolist() if end.has_lever else (0.0, 0.0, 0.0)
    return x, y, z


def _pair_fix(
    pair: Link, links: dict[tuple[str, str], GnssLink], ends: dict[str, VehicleVariables], K: int, ratio: float
) -> tuple[IntArray, IntArray, Array]:
    """Status of a pair: its own link's, or the worse of two links that lead from each end to the same reference."""
    direct = links.get((pair.reference, pair.rover)) or links.get((pair.rover, pair.reference))
    if direct is not None:
        return _fix_status(direct, ends[direct.link.rover], K, ratio)
    for middle in ends:
        a, b = links.get((middle, pair.reference)), links.get((middle, pair.rover))
        if a is not None and b is not None:
            x, y = (_fix_status(d, ends[d.link.rover], K, ratio) for d in (a, b))
            return np.minimum(x[0], y[0]), np.minimum(x[1], y[1]), x[2]
    return _fix_status(None, ends[pair.rover], K, ratio)


def _fix_status(link: GnssLink | None, rover: VehicleVariables, K: int, ratio: float) -> tuple[IntArray, IntArray, Array]:
    """Per grid time: Fix value, satellites in the differences, ratio."""
    fix, n_sat, ratios = np.zeros(K, np.int64), np.zeros(K, np.int64), np.full(K, np.nan)
    if link is None:
        return fix, n_sat, ratios
    block = link.block
    clocks = block.rows.clocks
    assert clocks is not None
    k_row = block.rover.query.k[block.point_rover]
    sat = block.rows.label_index
    seen = np.unique(k_row * (int(sat.max()) + 1) + sat)
    n_sat += np.bincount(seen // (int(sat.max()) + 1), minlength=K)
    phase = block.arc >= 0
    held = np.zeros(block.n, bool)
    state = np.array(link.state or [""])
    held[phase] = np.isin(state[block.arc[phase]], ["fixed", "datum"])
    # each constellation has its own datum, also where it shares the clock
    cells = CommonGroups.from_labels(clocks.of_row * len(block.rows.group) + block.rows.group_index)
    in_group = cells.sum(held.astype(float))
    k_group = k_row[cells.start]
    differences = np.bincount(k_group, np.maximum(in_group - 1, 0), minlength=K)
    any_phase = np.bincount(k_row[phase], minlength=K) > 0
    fix[any_phase] = Fix.FLOAT.value
    fix[differences >= 1] = Fix.PARTIAL.value
    fix[differences >= FIXED_DIFFERENCES] = Fix.FIXED.value
    # states without an epoch of their own, between two epochs, are as good as the worse of these
    seen = np.flatnonzero(n_sat > 0)
    if len(seen):
        before = seen[np.clip(np.searchsorted(seen, np.arange(K), side="right") - 1, 0, None)]
        after = seen[np.clip(np.searchsorted(seen, np.arange(K)), None, len(seen) - 1)]
        t = rover.t_s
        short = (t[after] - t[before] <= BETWEEN_EPOCHS_S) & (before <= np.arange(K)) & (after >= np.arange(K))
        fix = np.where((n_sat == 0) & short, np.minimum(fix[before], fix[after]), fix)
    ratios[fix >= Fix.PARTIAL.value] = ratio
    return fix, n_sat, ratios


def _ambiguities(graph: Graph, links: list[GnssLink], cov: Covariances | None) -> AmbiguityTable:
    links = [data for data in links if len(data.state)]
    if not links:
        return AmbiguityTable()
    names, values, sigmas, integers = [], [], [], []
    for data in links:
        keys = data.block.amb_key
        state = np.array(data.state)
        held = np.isin(state, ["fixed", "datum"])
        sigma = np.where(state == "fixed", data.float_sigma, np.nan) if len(data.float_sigma) else np.full(len(keys), np.nan)
        free = np.array([k != 0 and int(k) in graph.ambiguities for k in keys])
        if np.any(free) and cov is not None:
            sigma[free] = np.sqrt(cov.joints(keys[free][:, None])[:, 0, 0])
        names += [f"{data.link.reference}-{data.link.rover}"] * len(keys)
        unit = data.block.amb_unit_cyc
        values.append(unit * (data.float_cyc if len(data.float_cyc) else data.block.amb_value))
        sigmas.append(unit * sigma)
        integers.append(np.where(held, unit * np.round(data.block.amb_value), np.nan))
    return AmbiguityTable(
        link=tuple(names),
        satellite=tuple(s for data in links for s in data.arc_satellite),
        signal=tuple(s for data in links for s in data.arc_signal),
        t_start_s=np.concatenate([data.arc_start_s for data in links]),
        t_end_s=np.concatenate([data.arc_end_s for data in links]),
        float_cyc=np.concatenate(values),
        sigma_cyc=np.concatenate(sigmas),
        integer=np.concatenate(integers),
        state=tuple(s for data in links for s in data.state),
    )


def _measured(graph: Graph) -> list[Block]:
    return [b for b in graph.blocks if np.any(b.rows.kind >= 0)]


def _residuals(graph: Graph, outlier_sigma: float) -> ResidualTable:
    blocks = _measured(graph)
    if not blocks:
        return ResidualTable()
    sources: list[str] = []
    labels: list[str] = []
    parts: list[tuple[Array, ...]] = []
    for b in blocks:
        rows = b.rows
        active = b.active
        names = [f"{rows.source} {g}".strip() for g in rows.group]
        t = b.normalised()
        source = np.array([_index(sources, n) for n in names])[rows.group_index]
        label = np.array([_index(labels, n) for n in rows.label])[rows.label_index]
        outlier: BoolArray = np.abs(t) > outlier_sigma
        columns = (
            rows.kind,
            source,
            label,
            rows.t_s,
            b.residuals(),
            rows.single_sigma,
            b.w,
            outlier,
            rows.azimuth_rad,
            rows.elevation_rad,
            rows.cn0_dbhz if rows.cn0_dbhz is not None else np.full(b.n, np.nan),
            np.full(b.n, isinstance(b, GnssBlock) and b.reference is not None),
        )
        parts.append(tuple(np.asarray(c)[active] for c in columns))
    kind, source, label, t_s, residual, sigma, weight, outlier, azimuth, elevation, cn0, differenced = (
        np.concatenate([p[i] for p in parts]) for i in range(len(parts[0]))
    )
    series = source * max(len(labels), 1) + label
    classes = classify(KINDS, kind, series, t_s, residual, outlier, elevation, cn0, differenced)
    numbers = (kind, source, label, t_s, residual, sigma, weight, outlier, azimuth, elevation, cn0, classes)
    return ResidualTable(KINDS, tuple(sources), tuple(labels), *numbers)


def _index(names: list[str], name: str) -> int:
    if name not in names:
        names.append(name)
    return names.index(name)


def _nis(graph: Graph, cov: Covariances | None) -> tuple[Array, Array, Array]:
    """Sum of squared whitened residuals and its expectation per state time.

    E[e^T e] = rows - clocks - trace(J P J^T) for a factor with whitened Jacobian J and posterior covariance P of its
    variables; rows that robust weights push down do not count. Undifferenced code is left out: its standard deviation
    stands for errors that persist, so its residuals are small by intention. So are constraints, which nothing measures.
    """
    blocks = [b for b in _measured(graph) if not np.any(b.rows.kind == CONSTRAINT)]
    if not blocks or cov is None:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    t = graph.vehicles[0].t_s
    total, dof = np.zeros(len(t)), np.zeros(len(t))
    for b in blocks:
        b.whiten()
        starts = b.rows.factor.start
        counts = np.ones(b.n, bool)
        if isinstance(b, GnssBlock) and b.reference is None:
            counts = b.rows.kind != CODE
        sq = b.rows.factor.sum(np.where(counts, b.e**2, 0.0))
        expected = b.rows.factor.sum((counts & (b.w > 0.5)).astype(float))
        if b.rows.clocks is not None:
            first = b.rows.clocks.start
            observed = counts[first] & (b.rows.clocks.sum(b.active.astype(float)) > 0)
            np.subtract.at(expected, b.rows.factor.of_row[first], observed.astype(float))
        k = np.clip(np.searchsorted(t, b.rows.t_s[starts] + 5e-3, side="right") - 1, 0, len(t) - 1)
        expected -= b.rows.factor.sum(np.where(counts, b.explained(cov), 0.0))
        np.add.at(total, k, sq)
        np.add.at(dof, k, np.maximum(expected, 0.0))
    seen = dof > 0
    return t[seen], total[seen], dof[seen]


def _parameters(graph: Graph, cov: Covariances | None) -> tuple[ParameterEstimate, ...]:
    """Every estimated constant with its prior."""
    out = []
    for p in graph.parameters:
        sigma = np.sqrt(np.diag(cov.joint([p.key]))) if cov is not None else np.full(len(p.value), np.nan)
        for i, component in enumerate(p.components):
            values = (p.value[i], sigma[i], p.prior[i], p.sigma[i])
            out.append(ParameterEstimate(f"{p.name} {component}".strip(), p.unit, *(float(x) for x in values)))
    return tuple(out)


def _warnings(
    problem: NavigationProblem, built: Built, status: Status, singular: bool, pairs: tuple[PairSolution, ...]
) -> list[str]:
    out = []
    if status is not Status.CONVERGED:
        worst = built.graph.worst_row()
        out.append(f"the optimisation stopped early: {status.value}{'' if worst is None else f'; {worst}'}")
        out += built.graph.engine.remarks(built.graph)
    if singular:
        out.append("no covariance: the normal matrix is singular")
    for data in built.links:
        name = f"{data.link.reference}-{data.link.rover}"
        pair = next((p for p in pairs if (p.reference, p.rover) == (data.link.reference, data.link.rover)), None)
        if not problem.settings.ambiguity.fix or pair is None:
            continue
        with_phase = pair.fix > 0
        if not np.any(with_phase):
            out.append(f"{name}: no usable carrier phase; the baseline rests on code alone")
        elif not np.any(pair.fix == Fix.FIXED.value):
            out.append(f"{name}: no epoch's ambiguities could be fixed; the baseline is a float solution")
    return out


def _clock_notes(built: Built) -> list[str]:
    return [f"{name}: {rx.jumps}" for name, rx in built.receivers.items() if len(rx.jumps.t_s)]


def _slip_notes(links: list[GnssLink], slips: SlipTable) -> list[str]:
    notes = []
    for data in links:
        released = sum(s == "released" for s in data.state)
        text = f"{data.link.reference}-{data.link.rover}: {len(data.state)} phase arcs"
        mine = slips.of_link(f"{data.link.reference}-{data.link.rover}")
        causes = [c for c, mended in zip(mine.cause, mine.repaired, strict=True) if not mended]
        found = ", ".join(f"{causes.count(cause)} by {cause}" for cause in sorted(set(causes)))
        text += f"; arcs ended: {found}" if found else ""
        mended = int(np.sum(mine.repaired & (mine.cycles != 0)))
        text += f"; {mended} slips repaired" if mended else ""
        text += f"; {int(np.sum(mine.repaired)) - mended} ends of arcs without a slip joined" if np.any(mine.cycles == 0) else ""
        text += f"; {released} integers released" if released else ""
        notes.append(text)
    return notes
