"""The relative filter on simulated flights of two and three UAVs: rows, truth without noise, pairs, as a method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from factorgraph.errors import InputError
from factorgraph.filters.relative import flight, rows, start
from factorgraph.filters.relative.flight import Configuration, Formation, prepare, truth_of
from factorgraph.filters.relative.motion import position, velocity
from factorgraph.filters.relative.own import own_motions
from factorgraph.models.receivers import receivers
from factorgraph.problem import Link, NavigationProblem
from factorgraph.registry import solve
from factorgraph.solution import Status
from factorgraph.types import Array, BoolArray
from scenarios.published import ahrs_tdo
from scenarios.simulate import simulate
from tests.helpers import numerical_jacobian


def flown(n: int, noise_scale: float, seed: int = 3, duration_s: float = 60.0) -> NavigationProblem:
    scene = ahrs_tdo.scenario(n=n)
    info = scene.scenario.model_copy(update={"duration_s": duration_s, "noise_scale": noise_scale})
    uwb = tuple(table.model_copy(update={"scale_ppm": 0.0}) for table in scene.range)
    return ahrs_tdo.without_phases(simulate(scene.model_copy(update={"scenario": info, "range": uwb}), seed).problem)


def formation_of(problem: NavigationProblem) -> Formation:
    rx = receivers(problem)
    return prepare(problem, own_motions(problem, rx), rx)


@pytest.fixture(scope="module")
def exact() -> Formation:
    return formation_of(flown(3, 0.0))


@pytest.fixture(scope="module")
def noisy() -> NavigationProblem:
    return flown(2, 1.0)


def true_states(formation: Formation, k: int, n: int) -> Array:
    x = np.zeros(n)
    for i, name in enumerate(formation.names[1:]):
        true = truth_of(formation, formation.names[0], name)
        assert true is not None and true[1] is not None
        x[position(i)], x[velocity(i)] = true[0][k], true[1][k]
    return x


def test_check_6_rows_are_derivatives_and_labelled(exact: Formation) -> None:
    c = Configuration()
    moving = exact._motion(c)
    sources = exact._sources(c, moving.size)
    x = true_states(exact, 20, moving.size)

    def innovations(d: Array) -> Array:
        return rows.stacked([found for s in sources if (found := s.rows(20, x + d)) is not None]).linearised(x + d)[0]

    found = rows.stacked([part for s in sources if (part := s.rows(20, x)) is not None])
    nu, H = found.linearised(x)
    np.testing.assert_allclose(H, -numerical_jacobian(innovations, moving.size, 0.1), atol=1e-5)
    kinds = [rows.KINDS[k] for k in found.kind]
    m = kinds.count("code") // 2
    absolute = 2 * (3 * ["position"] + 3 * ["velocity"])
    assert kinds == 2 * m * ["code"] + 2 * m * ["doppler"] + absolute + 3 * ["range"]
    pivots = {label.split("-")[-1] for label, kind in zip(found.labels, kinds, strict=True) if kind == "code"}
    assert len(pivots) == 1 and found.labels[0].startswith("follower G")
    assert found.labels[-3:] == ("leader-follower", "leader-follower-2", "follower-follower-2")
    assert np.max(np.abs(nu[found.kind == rows.CODE])) < 1e-3  # without noise, at the truth, each row says nothing
    assert np.max(np.abs(nu[found.kind == rows.DOPPLER])) < 1e-4
    assert np.max(np.abs(nu[found.kind == rows.RANGE])) < 1e-4


def test_differences_share_noise_as_stated(exact: Formation) -> None:
    c = Configuration(kinds=("code", "doppler"))
    source = exact._sources(c, 21)[0]
    found = source.rows(20, true_states(exact, 20, 21))
    assert found is not None
    code = found.kind == rows.CODE
    R = found.R[np.ix_(code, code)]
    m = len(R) // 2
    sigma = exact.noise[0].rover.code_m
    np.testing.assert_allclose(np.diag(R), 4 * sigma**2)
    assert R[0, 1] == pytest.approx(2 * sigma**2)  # one pivot
    assert R[0, m] == pytest.approx(2 * sigma**2)  # one reference: its satellite and its pivot
    assert R[0, m + 1] == pytest.approx(sigma**2)
    assert np.linalg.eigvalsh(found.R).min() > 0


def test_without_noise_the_truth_comes_back(exact: Formation) -> None:
    track = exact.run(Configuration())
    for a, b in ((0, 1), (0, 2), (1, 2)):
        r, v, P = track.pair(a, b)
        true = truth_of(exact, exact.names[a], exact.names[b])
        assert true is not None and true[1] is not None
        assert np.linalg.norm(r[-1] - true[0][-1]) < 0.02 and np.linalg.norm(v[-1] - true[1][-1]) < 2e-3
        assert np.linalg.eigvalsh(P[-1]).min() > 0


@pytest.mark.parametrize("motion", ["velocity", "acceleration"])
def test_smooth_motions_follow_as_well(exact: Formation, motion: str) -> None:
    track = exact.run(Configuration(motion=motion, walk=0.5))  # type: ignore[arg-type]
    true = truth_of(exact, "leader", "follower")
    assert true is not None
    assert np.linalg.norm(track.pair(0, 1)[0][-1] - true[0][-1]) < 0.3


def test_as_a_method(noisy: NavigationProblem) -> None:
    solution = solve(noisy, "relative")
    pair = solution.pair("leader", "follower")
    assert solution.diagnostics.status is Status.CONVERGED
    assert pair.truth_enu is not None and pair.truth_velocity_enu is not None
    e = pair.baseline_enu - pair.truth_enu
    z = e[-20:] / np.sqrt(np.diagonal(pair.P[-20:, :3, :3], axis1=1, axis2=2))
    assert np.max(np.abs(z)) < 4.5 and np.sqrt(np.mean(e[-20:] ** 2)) < 2.0
    assert np.min(pair.n_sat) >= 6
    assert {solution.residuals.kind[k] for k in np.unique(solution.residuals.kind_index)} == {"code", "doppler", "range"}
    assert np.all(np.isfinite(solution.vehicle("follower").r_n))
    assert 0.5 < np.mean(solution.diagnostics.nis / solution.diagnostics.nis_dof) < 1.5


def test_a_wanted_pair_of_followers() -> None:
    problem = flown(3, 1.0, duration_s=20.0)
    pair = replace(problem.links[0], reference="follower", rover="follower-2")
    solution = solve(replace(problem, pairs=(pair,)), "relative")
    assert [(p.reference, p.rover) for p in solution.pairs] == [("follower", "follower-2")]
    assert np.linalg.norm(solution.pairs[0].baseline_enu[-1] - solution.pairs[0].truth_enu[-1]) < 10.0  # type: ignore[index]


def test_what_cannot_be_done_is_told(noisy: NavigationProblem) -> None:
    bare = replace(noisy, vehicles=tuple(replace(v, imu=None) for v in noisy.vehicles))
    with pytest.raises(InputError, match="vehicle leader: the relative filter needs its attitude and specific force"):
        solve(bare, "relative")
    with pytest.raises(InputError, match="no measurements called carrier; there are code, doppler"):
        Configuration(kinds=("carrier",))
    alone = replace(noisy, vehicles=noisy.vehicles[:1], links=(), ranges=())
    with pytest.raises(InputError, match="two moving vehicles, a base or anchors; there is leader"):
        prepare(alone, own_motions(alone, {}), {})


@pytest.mark.parametrize("late_s", [0.0009, 0.0011, 0.0021])
def test_no_measurement_counts_twice_where_clocks_differ(noisy: NavigationProblem, late_s: float) -> None:
    """Ranges a little after GNSS: one epoch or two, but the same rows."""
    model = noisy.ranges[0]
    later = replace(model, stream=replace(model.stream, t_s=model.stream.t_s + late_s))
    counts = []
    for problem in (noisy, replace(noisy, ranges=(later,))):
        found = formation_of(problem).run(Configuration(kinds=("code", "doppler", "range")))
        counts.append(int(np.sum(found.n_rows)))
    assert counts[0] - 1 <= counts[1] <= counts[0]  # the last range may fall behind the IMU's end


def last_errors(problem: NavigationProblem) -> list[float]:
    """Of every pair [m]."""
    formation = formation_of(problem)
    track = formation.run(Configuration(kinds=("code", "doppler", "range")))
    out = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        true = truth_of(formation, formation.names[a], formation.names[b])
        assert true is not None
        out.append(float(np.linalg.norm(track.pair(a, b)[0][-1] - true[0][-1])))
    return out


def test_whatever_ends_links_have_followers_are_differenced_against_the_reference() -> None:
    problem = flown(3, 1.0, duration_s=40.0)
    a, b, c = (v.name for v in problem.vehicles)
    for links in ([(a, b), (b, c)], [(a, c), (b, c)], [(c, a), (c, b)]):
        chain = replace(problem, links=tuple(Link(x, y) for x, y in links), pairs=(Link(a, c),))
        formation = formation_of(chain)
        assert len(formation.links) == 2 and formation.names[0] in links[0] and formation.names[0] in links[1]
        assert max(last_errors(chain)) < 4.0
    without = replace(problem, links=())
    assert not formation_of(without).links and max(last_errors(without)) < 8.0  # absolute differences instead


def test_a_base_station_may_be_the_reference() -> None:
    scene = ahrs_tdo.scenario(n=2)
    info = scene.scenario.model_copy(update={"duration_s": 30.0})
    tables = [v.model_dump(exclude_none=True) for v in scene.vehicle]
    base = {
        "name": "base",
        "trajectory": {"kind": "static", "r_n": (0.0, 0.0, 900.0)},
        "gnss": tables[0]["gnss"],
        "is_base": True,
    }
    links = [{"reference": "base", "rover": "leader"}, {"reference": "base", "rover": "follower"}]
    whole = type(scene).model_validate(
        scene.model_dump(exclude_none=True)
        | {"scenario": info.model_dump(exclude_none=True), "vehicle": [base, *tables], "link": links}
        | {"pair": [{"reference": "leader", "rover": "follower"}]}
    )
    solution = solve(ahrs_tdo.without_phases(simulate(whole, 3).problem), "relative")
    pair = solution.pair("leader", "follower")
    assert "reference of the filter: base" in solution.diagnostics.notes
    assert pair.truth_enu is not None and np.linalg.norm(pair.baseline_enu[-1] - pair.truth_enu[-1]) < 4.0


def test_attitudes_that_end_early_or_have_a_gap_are_told(noisy: NavigationProblem) -> None:
    def with_attitudes(keep: Callable[[Array], BoolArray]) -> NavigationProblem:
        out = []
        for v in noisy.vehicles:
            stream = v.attitudes[0]
            rows_kept = keep(stream.t_s)
            cut = replace(stream, t_s=stream.t_s[rows_kept], q_nb=stream.q_nb[rows_kept], sigma_rad=stream.sigma_rad[rows_kept])
            out.append(replace(v, attitudes=(cut,)))
        return replace(noisy, vehicles=tuple(out))

    solution = solve(with_attitudes(lambda t: t < 30.0), "relative")
    assert solution.pairs[0].t_s[-1] < 30.1
    assert any("IMUs and attitudes of all vehicles cover" in warning for warning in solution.diagnostics.warnings)
    with pytest.raises(InputError, match=r"vehicle leader: its attitudes ahrs are missing from 19\.\d+ to 25\.\d+ s"):
        solve(with_attitudes(lambda t: (t < 20.0) | (t > 25.0)), "relative")


ANCHORS = np.array([[5.0, 5.0, 2.0], [5.0, -5.0, 2.1], [-5.0, -5.0, 1.9], [-5.0, 5.0, 2.2]])


def standing(true: Array, sigma: float, n_epochs: int = 6) -> dict[int, list[rows.RangeRow]]:
    """Ranges from anchors of the ground to two followers that stand at `true` (2, 3), and between these."""
    rng = np.random.default_rng(4)
    out: dict[int, list[rows.RangeRow]] = {}
    for k in range(n_epochs):
        found = [
            rows.RangeRow(0, i + 1, -a, float(np.linalg.norm(true[i] - a) + sigma * rng.normal()), 0.1, f"{j}-{i}")
            for i in (0, 1)
            for j, a in enumerate(ANCHORS)
        ]
        found.append(rows.RangeRow(1, 2, np.zeros(3), float(np.linalg.norm(true[1] - true[0])), 0.1, "b"))
        out[k] = found
    return out


def test_followers_are_placed_by_ranges_and_the_first_height_tells_up_from_down() -> None:
    t = np.arange(6.0)
    names = (flight.GROUND, "a", "b")
    for up in (0.2, 3.8):  # below and above the anchors
        true = np.array([[1.0, 2.0, up], [-2.0, 0.5, up]])
        heights = {8: [rows.HeightRow(i, np.array([0.0, 0.0, 1.0]), up + 0.5, 0.1, "h") for i in (0, 1)]}
        x, P = start.placed(standing(true, 0.05), heights, t, names, rest_s=10.0)
        found = np.array([x[position(0)], x[position(1)]])
        np.testing.assert_allclose(found, true, atol=0.4)
        sigma = np.sqrt(np.diag(P)[[3, 4, 5]])
        assert np.all(np.abs(found[0] - true[0]) < 4 * sigma) and np.linalg.eigvalsh(P).min() > 0
        assert x[velocity(0)] == pytest.approx(np.zeros(3)) and P[0, 0] == pytest.approx(start.SPEED_MPS[0] ** 2)


def test_too_few_ranges_place_nothing() -> None:
    few = {0: 3 * [rows.RangeRow(0, 1, -ANCHORS[0], 5.0, 0.1, "a")]}
    with pytest.raises(InputError, match=r"vehicle a: ranges to 1 tags until 3\.0 s, too few to place it"):
        start.placed(few, {}, np.zeros(1), (flight.GROUND, "a"), None)
    among = {0: [rows.RangeRow(1, 2, np.zeros(3), 5.0, 0.1, name) for name in "abc"]}
    with pytest.raises(InputError, match=r"ranges to 0 anchors until 3\.0 s"):
        start.placed(among, {}, np.zeros(1), (flight.GROUND, "a", "b"), None)
