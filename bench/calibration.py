"""Calibration measured: seconds and memory against samples and joints, and beside its peers.

Sessions are made by the package's own model: Sobol poses, joint zeros, geometry within its
tolerances, 0.3 mm of noise.  Peers fit the same parameters to the same data; what each leaves on
held-out poses is told beside its time, since a ratio counts only where the error is no worse.
"""

from __future__ import annotations

import time
from functools import lru_cache

import numpy as np
from scipy.stats import qmc

from bench.apart import cost_of
from bench.arms import demo_arm
from bench.calibration_peers import by_finite_differences, pybotics
from bench.comparison import Result, alone, beside, missing
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.errors import JobError
from longarm_comp.core.identify.calibrate import Errors, errors, geometry
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.studies.real_sessions import declared

NOISE_M = 3e-4
SIZES = (300, 3_000, 30_000, 100_000)
ARMS = ("ur5", "wam", "justin_left")


def made_session(
    arm: Arm, samples: int, seed: int = 0, *, rigid: bool = False, hidden: tuple[Effect, ...] = ()
) -> Session:
    """A session of an arm whose geometry is off by half its tolerances, 0.3 mm of noise."""
    unit = qmc.Sobol(arm.n, seed=seed).random(1 << (samples - 1).bit_length())[:samples]
    q = arm.lower + (arm.upper - arm.lower) * unit
    blank = Session.record(q, np.zeros((samples, 3)), source="benchmark")
    nominal = _start(arm, blank, rigid=rigid)
    scale = np.array([slot.parameter.prior for slot in nominal.slots])
    bad = 0.5 * scale * np.random.default_rng(12).standard_normal(len(scale))
    truth = nominal.with_values(bad).plus(*hidden)
    noise = NOISE_M * np.random.default_rng([seed, samples]).standard_normal((samples, 3))
    xyz = truth.measured(q, blank.context()) + noise
    return Session.record(q, xyz, source="benchmark")


def _start(arm: Arm, session: Session, *, rigid: bool = False) -> Model:
    base = Model(arm) if rigid else declared_model(arm)
    return base.plus(*geometry(arm, session))


def _held_out_mm(model: Model, session: Session) -> float:
    return 1e3 * Errors.of(errors(model, session)).mean


# ------------------------------------------------------------------ run in processes of their own


def fit_once(samples: int, name: str = "demo", rigid: bool = False) -> dict[str, float]:
    """Fit one made session; its own seconds are told, since making the data costs too."""
    arm = _arm(name)
    session = made_session(arm, samples, rigid=rigid)
    start, used = _start(arm, session, rigid=rigid), time.process_time()
    fitted = fit(start, session)
    return {
        "cpu_s": time.process_time() - used,
        "iterations": fitted.iterations,
        "parameters": len(fitted.slots),
        "converged": float(fitted.converged),
    }


def _arm(name: str) -> Arm:
    return demo_arm() if name == "demo" else declared(name)


# ------------------------------------------------------------------ against samples and joints


@lru_cache(maxsize=1)
def against_samples(sizes: tuple[int, ...] = SIZES) -> list[Result]:
    """Processor seconds and memory of one fit of everything that is always fitted."""
    rows: list[Result] = []
    for samples in sizes:
        cost = cost_of(__name__, "fit_once", samples)
        fitted = cost.result
        steps = int(fitted["iterations"])
        rows.append(
            alone(
                f"calibrate_{samples}",
                "s CPU",
                [fitted["cpu_s"]],
                f"{int(fitted['parameters'])} parameters, {steps} steps",
                grown_mb=cost.grown_mb,
                us_per_sample_and_step=1e6 * fitted["cpu_s"] / samples / (steps + 1),
            )
        )
    return rows


def calibrate_300() -> Result:
    """300 samples."""
    return against_samples()[0]


def calibrate_3000() -> Result:
    """3,000 samples."""
    return against_samples()[1]


def calibrate_30000() -> Result:
    """30,000 samples."""
    return against_samples()[2]


def calibrate_100000() -> Result:
    """100,000 samples; the ratio is that to linear growth from 3,000."""
    small, large = (against_samples()[k] for k in (1, 3))
    each = [float(row["us_per_sample_and_step"]) for row in (small, large)]  # type: ignore[arg-type]
    peer = "linear growth from 3,000"
    ratio = each[0] / each[1]
    return {**large, "peer": peer, "ratio": ratio, "spread": [ratio, ratio]}


def calibrate_joints() -> Result:
    """The arm with most joints against the demonstration's, per sample, step and parameter."""
    costs = {
        name: cost_of(__name__, "fit_once", 3000, name, True).result for name in ("demo", *ARMS)
    }
    each = {
        name: 1e6 * fit["cpu_s"] / 3000 / (fit["iterations"] + 1) / fit["parameters"]
        for name, fit in costs.items()
    }
    told = {f"{name}_us_per_sample_step_parameter": value for name, value in each.items()}
    last = ARMS[-1]
    return beside(
        "calibrate_joints",
        "us/sample/step/parameter",
        [each[last]],
        f"linear growth from {int(costs['demo']['parameters'])} parameters (demo)",
        [each["demo"]],
        note=f"{last}: {int(costs[last]['parameters'])} parameters, rigid, 3,000 samples",
        **told,
    )


# ------------------------------------------------------------------ against peers


def calibrate_vs_scipy(samples: int = 300, repeats: int = 3, *, rigid: bool = False) -> Result:
    """Everything that is always fitted, against finite differences; the arm sags unless rigid."""
    arm = demo_arm()
    held_out = made_session(arm, 512, 99, rigid=rigid)
    ours, theirs, left = [], [], ([], [])  # type: ignore[var-annotated]
    for seed in range(repeats):
        session = made_session(arm, samples, seed, rigid=rigid)
        start, sigma = _start(arm, session, rigid=rigid), NOISE_M
        begin = time.perf_counter()
        mine = fit(start, session)
        ours.append(time.perf_counter() - begin)
        begin = time.perf_counter()
        other = by_finite_differences(start, session, sigma)
        theirs.append(time.perf_counter() - begin)
        left[0].append(_held_out_mm(mine.model, held_out))
        left[1].append(_held_out_mm(other, held_out))
    return beside(
        "calibrate_vs_scipy",
        "s",
        ours,
        "scipy least_squares, 2-point, same parameters and priors, noise known",
        theirs,
        held_out_mm=float(np.median(left[0])),
        peer_held_out_mm=float(np.median(left[1])),
        note=f"{samples} samples, {len(start.slots)} parameters",
    )


def calibrate_vs_pybotics(samples: int = 300, repeats: int = 2) -> Result:
    """Rigid geometry alone, against pybotics and SciPy as its documentation has it."""
    arm, name = demo_arm(), "calibrate_vs_pybotics"
    held_out = made_session(arm, 512, 99, rigid=True)
    ours, left = [], []
    try:
        theirs = []
        for seed in range(repeats):
            session = made_session(arm, samples, seed, rigid=True)
            start = _start(arm, session, rigid=True)
            begin = time.perf_counter()
            mine = fit(start, session)
            ours.append(time.perf_counter() - begin)
            left.append(_held_out_mm(mine.model, held_out))
            theirs.append(pybotics(arm, session, held_out))
    except JobError as error:
        return missing(name, "pybotics", str(error))
    return beside(
        name,
        "s",
        ours,
        "pybotics 3.1.2 with scipy least_squares",
        [peer.seconds for peer in theirs],
        held_out_mm=float(np.median(left)),
        peer_held_out_mm=float(np.median([peer.held_out_mm for peer in theirs])),
        note=f"{samples} samples, {len(start.slots)} parameters, peer {theirs[0].parameters}",
    )
