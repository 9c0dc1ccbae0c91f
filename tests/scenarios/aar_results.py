"""Made-up results of the refuelling study: arrays as its jobs return them, with effects of known size."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from factorgraph.types import Array, BoolArray
from scenarios.studies.aar_summary import ALGORITHMS, DEFAULT, GRAPH, MANOEUVRES_S, SWEEP, JobKey

K = 1201
SUCCESS = {"1": 0.55, "2": 0.80, "3": 0.90, "4": 0.93, "5": 0.95, "g": 0.999}
WINDOWS_S = {1: (), 2: (200, 500, 800, 1100), 3: (400, 600), 4: (300, 700)}
VELOCITY_MPS = {"a": 0.013, "b": 0.010}
SPIKE_MPS = 0.05  # of the standard filter at the manoeuvre changes


class MadeUp(Mapping[JobKey, Mapping[str, Array]]):
    """Results that are made when asked for, and counted, so that a test can see what is held at once."""

    def __init__(self, keys: Sequence[JobKey], algorithms: Sequence[str] = ALGORITHMS, n_epochs: int = K) -> None:
        self.keys_, self.algorithms, self.n_epochs = list(keys), tuple(algorithms), n_epochs
        self.n_loaded = 0

    def __getitem__(self, key: JobKey) -> Mapping[str, Array]:
        if key not in self.keys_:
            raise KeyError(key)
        self.n_loaded += 1
        if key.variant == SWEEP:
            return sweep_trial(key.seed)
        return trial(key, self.algorithms, self.n_epochs)

    def __iter__(self) -> Iterator[JobKey]:
        return iter(self.keys_)

    def __len__(self) -> int:
        return len(self.keys_)


def made_up(
    n_seeds: int, data: Sequence[int] = (1, 2, 3, 4), variants: Sequence[str] = (DEFAULT, SWEEP),
    algorithms: Sequence[str] = ALGORITHMS, n_epochs: int = K,
) -> MadeUp:  # fmt: skip
    """Every data set and variant with seeds 1 to n; the sweep and the variant "start" are on Data 1 alone."""
    keys = []
    for variant in variants:
        sets = [d for d in data if d == 1 or variant not in (SWEEP, "start", "literal-noise")]
        starts = range(1, 5) if variant == "start" else (0,)
        keys += [JobKey(variant, d, seed, start) for d in sets for start in starts for seed in range(1, n_seeds + 1)]
    return MadeUp(keys, algorithms, n_epochs)


def trial(key: JobKey, algorithms: Sequence[str] = ALGORITHMS, n_epochs: int = K) -> dict[str, Array]:
    """One trial: success as in SUCCESS (a tenth of it under the literal noise), no success in windows for the unprotected."""
    t_s = np.arange(n_epochs, dtype=float)
    faulted = np.zeros(n_epochs, bool)
    for start in WINDOWS_S[key.data]:
        faulted |= (t_s >= start) & (t_s <= start + 10)
    uav = np.column_stack([-4800 * np.exp(-t_s / 80), 3000 * np.exp(-t_s / 80) + 100 * t_s, np.minimum(t_s - 90, 0.0)])
    tanker = np.column_stack([0 * t_s, 100 * t_s, 0 * t_s])
    arrays: dict[str, Array] = {"t_s": t_s, "faulted": faulted, "truth_uav_n": uav, "truth_tanker_n": tanker}
    arrays |= {"n_sat": np.full(n_epochs, 10.0), "baseline_m": np.linalg.norm(uav - tanker, axis=1)}
    angle = np.linspace(0, 360, 10, endpoint=False)
    arrays["azimuth_deg"] = (angle + 0.004 * t_s[:, None]) % 360
    arrays["elevation_deg"] = 30 + 5.0 * np.arange(10) + 0.003 * t_s[:, None]
    arrays["elevation_deg"][: n_epochs // 2, 3] = np.nan
    arrays["satellites"] = np.array([f"C{20 + i}" for i in range(10)])
    for algorithm in algorithms:
        rng = np.random.default_rng([key.seed, key.start, len(key.variant), ALGORITHMS.index(algorithm)])
        found = _algorithm(algorithm, key, t_s, faulted, rng)
        arrays |= {f"{algorithm}/{name}": value for name, value in found.items()}
    return arrays


def _algorithm(algorithm: str, key: JobKey, t_s: Array, faulted: BoolArray, rng: np.random.Generator) -> dict[str, Array]:
    n, scheme = len(t_s), algorithm[0]
    share = SUCCESS[scheme] * (0.1 if key.variant == "literal-noise" else 1.0)
    cures = scheme in {2: "45g", 3: "5g", 4: "5g"}.get(key.data, "12345g")
    draw = rng.uniform(size=n)
    success = (draw < share) & (cures | ~faulted)
    wrong = (draw > 0.99) & ~success
    fixed = success | wrong
    size_m = np.where(success, 0.01, 0.5)
    for i, start in enumerate(WINDOWS_S[key.data]):
        if not cures:
            size_m[(t_s >= start) & (t_s <= start + 10)] *= 2**i
    near = (np.abs(t_s[:, None] - np.array(MANOEUVRES_S)) <= 3).any(axis=1)
    speed = VELOCITY_MPS.get(algorithm[1], 0.005) + np.where(near & (algorithm[1] == "a"), SPIKE_MPS, 0.0)
    found = {
        "correct": success, "fixed": fixed, "baseline_error_m": size_m[:, None] * rng.standard_normal((n, 3)) / np.sqrt(3),
        "velocity_error_mps": speed[:, None] * rng.standard_normal((n, 3)) / np.sqrt(3),
        "ratio": np.where(fixed, 3.0 + rng.exponential(SUCCESS[scheme] * 5, n), rng.uniform(1, 3, n)),
        "adop_cyc": np.full(n, 0.3 - 0.2 * SUCCESS[scheme]), "success_rate": np.full(n, share), "runtime_s": np.array(1.5),
        "nees": rng.chisquare(3 if algorithm == GRAPH else 6, n) * (2.0 if algorithm == "1a" else 1.0),
    }  # fmt: skip
    if algorithm == GRAPH:
        return found | {"ratio": np.full(n, np.nan)}
    found |= {"main_baseline_error_m": 1.1 * found["baseline_error_m"], "nis": rng.chisquare(20, n) / 20}
    found |= {"ins_sigma_m": np.full(n, 0.1), "alpha": np.where(wrong & (key.variant == "normalised"), 0.3, 1.0)}
    return found


def sweep_trial(seed: int) -> dict[str, Array]:
    """ADOP of WLS grows with the code sigma; that of IEKF is below EKF's everywhere; a bias beyond 0.5 m hurts IEKF."""
    code, ins, bias = np.array([0.1, 0.5, 1, 2, 3]), np.array([0.1, 0.5, 1, 1.5, 3, 10]), np.array([0, 0.25, 0.5, 1, 2])
    jitter = 1 + 0.01 * np.random.default_rng(seed).standard_normal()
    return {
        "code_sigma_m": code, "adop_code": jitter * np.array([0.1 + 0.3 * code, 0.1 + 0.02 * code, 0.05 + 0.01 * code]),
        "ins_sigma_m": ins, "adop_ins": jitter * np.array([0 * ins + 0.2, 0 * ins + 0.1, 0.1 * ins / np.hypot(ins, 0.7)]),
        "bias_m": bias, "success_bias": np.clip([0 * bias + 0.85, 0.95 - 0.2 * bias], 0, 1) * min(jitter, 1),
        "success_ins": np.array([0 * ins + 0.85, 0.85 + 0.1 * np.exp(-ins)]),
    }  # fmt: skip
