"""Causes that are in no library: what calibration, library, discovery and learning leave of them.

Every case hides one cause of `studies/outside.py` besides errors of geometry. Errors are against
the noise-free truth, on fresh poses of the plan that was measured and at random poses off it.
"""

import itertools
import time
from dataclasses import dataclass
from typing import Any

import click
import numpy as np

from longarm_comp.cli import options
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.plan import grid, sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.workflows.diagnose import diagnose
from longarm_comp.workflows.train import training_rows
from studies.commands import Figures, Show, arm_option, study_command, whole_number
from studies.outside import outside
from studies.peers import train_gaussian_process
from studies.simulated import SimulatedSession, measure_session
from studies.true_camera import draw_geometry_errors, make_truth

NOTHING = "nothing"
ROWS, REPEATS, HELD_OUT, FRESH = 240, 8, 100, 200
PLANS = {"grid": grid, "sobol": sobol}


@dataclass(frozen=True)
class Setting:
    """Measured rows of a case, and fresh poses with the truth.

    Attributes:
        train, held_out: sessions.
        on, off: fresh rows on the plan and off it, (session, (N, 3) noise-free positions in m).
    """

    train: Session
    held_out: Session
    on: tuple[Session, np.ndarray]
    off: tuple[Session, np.ndarray]


def set_up(arm: Arm, case: str, plan: str, seed: int, rows: int = ROWS) -> Setting:
    """Hide the cause of a case, and measure.

    The hold-out has as many rows of the plan as off it.
    """
    rng = np.random.default_rng([seed, *case.encode()])
    off = draw_geometry_errors(arm, 1.0, rng)
    cause = [] if case == NOTHING else [outside(arm)[case]]
    true, eye = make_truth(arm, (*cause, *off))

    def measure(q: np.ndarray, repeats: int = 0, spoiled: float = 0.0) -> SimulatedSession:
        return measure_session(true, eye, q, rng=rng, repeats=repeats, outliers=spoiled)

    train = measure(PLANS[plan](arm, rows, rng).q, REPEATS, 0.005)
    half = HELD_OUT // 2
    both = np.concatenate([PLANS[plan](arm, half, rng).q[:half], sobol(arm, half, rng).q])
    held_out = measure(both[rng.permutation(len(both))])
    fresh = [measure(p(arm, FRESH, rng).q) for p in (PLANS[plan], sobol)]
    return Setting(train.session, held_out.session, *((m.session, m.truth["seen"]) for m in fresh))


def row(arm: Arm, case: str, plan: str, seed: int, network: bool) -> dict[str, Any]:
    """Return errors (rms, mm; on the plan and off it) of every stage, and what was found."""
    setting = set_up(arm, case, plan, seed)
    began = time.perf_counter()
    found = diagnose(
        arm, setting.train, test=setting.held_out, network=network, seed=seed, note=lambda _: None
    )
    took = time.perf_counter() - began
    models = found.diagnosis.models
    library = models["with_effects"]
    stages = {
        "calibrated": _errors(models["calibrated"], setting),
        "library": _errors(library, setting),
        "discovered": _errors(found.model, setting),
    }
    if network:
        stages["network"] = _errors(found.model, setting, found.predictor)
    bases = [models["calibrated"], *([library] if library is not models["calibrated"] else [])]
    peers = [
        _errors(m, setting, train_gaussian_process(*training_rows(m, setting.train), seed=seed))
        for m in bases
    ]
    stages["gp"] = min(peers, key=sum)
    made: dict[str, Any] = {"case": case, "plan": plan, "seed": seed}
    for name, (on, off) in stages.items():
        made[f"{name}_mm"] = f"{on:.2f} / {off:.2f}"
    causes = found.diagnosis.causes
    return {
        **made,
        "s": round(took),
        "names": ", ".join(f.name for f in found.findings),
        "found": "; ".join(c.formula for c in causes),
        "or": "; ".join(" or ".join(c.where[1:3]) for c in causes if len(c.where) > 1),
    }


def _errors(model: Model, setting: Setting, learned: Any = None) -> tuple[float, float]:
    made = []
    for rows, truth in (setting.on, setting.off):
        predicted = model.measured(rows.q, rows.context())
        if learned is not None:
            expected = learned.predict(rows.q, rows.context())
            predicted = predicted + np.where(expected.in_domain[:, None], expected.error, 0.0)
        made.append(1e3 * float(np.sqrt(((predicted - truth) ** 2).sum(axis=1).mean())))
    return made[0], made[1]


@study_command(
    arm_option,
    click.option("--case", "chosen", multiple=True, help="Case; repeat for more. Default: all."),
    click.option(
        "--plan", "plans", multiple=True, type=click.Choice(["grid", "sobol"]), default=("grid",),
        show_default=True, help="Poses that are measured; repeat for both.",
    ),
    whole_number("--seeds", 1, "Seeds of each case."),
    click.option("--no-network", is_flag=True, help="Leave out the network."),
    options.seed,
)  # fmt: skip
def command(
    arm: Arm, chosen: tuple[str, ...], plans: tuple[str, ...], seeds: int, no_network: bool,
    seed: int, show: Show,
) -> Figures:  # fmt: skip
    """Hide causes that are in no library, and print the error left by each method.

    Errors are rms in mm against the truth without noise: on fresh poses of the plan that was
    measured, and at random poses off it. "nothing" hides nothing.

    \b
    Example:
      longarm study discover --case hose_pull --case nothing
    """
    known = (*outside(arm), NOTHING)
    for case in chosen:
        if case not in known:
            raise InputError("study discover", "case", case, ", ".join(known))
    cases = list(itertools.product(chosen or known, plans, range(seed, seed + seeds)))
    rows = []
    for case, plan, each in cases:
        rows.append(row(arm, case, plan, each, not no_network))
        show(f"{case} {plan}", len(rows) / len(cases))
    return Figures({"rows": rows}, {"Errors against the truth, on the plan / off it": rows})
