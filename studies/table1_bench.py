"""The paper's Table I on many simulated arms that execute the commands.

Every arm is a variant of one declared arm with hidden effects of its own, sized as the paper's
(`random_arms`).  It is measured on the III.B grid (900 poses; the first 300 are the small set).
Each row of the table is trained on these rows.  Then 40 random targets are commanded to the
simulated arm, and the errors of its true tip are evaluated.

The paper's rows are the paper's scheme: one SSA-BP network of 12 hidden units on the commanded
joints alone, one pseudo-target pass, each joint rounded to its servo's steps by itself.  The other
rows know the steps: the model rounds as the servos do, and joints are chosen among the steps.
The peer is a Gaussian process on the same inputs as the network.  The best setting calibrates,
adds the effects that the training rows ask for, and learns the rest from joints and context.  A
row that uses the approach direction gets the one with which the arm arrives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.calibrate import Errors, declared_model, geometry_terms
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.compensation.compensate import Method
from longarm_comp.core.data.plan import grid, paper_grid, random_joints
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.learn.ensemble import train
from longarm_comp.core.learn.predictor import LearnedGain
from longarm_comp.core.model.model import Model
from longarm_comp.sim import context as sim_context
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.drives import ServoQuantisation
from longarm_comp.workflows.train import training_rows
from studies.extra import extra
from studies.many import compensate_arrays
from studies.peers import train_gaussian_process
from studies.random_arms import paper_mix, random_arm
from studies.simulated import measure_session
from studies.true_camera import Hidden, TrueCamera, hidden, make_truth

TARGETS = 40
SAMPLES = (900, 300)
HIDDEN = 12
_JOINTS_ONLY = "joints"


@dataclass(frozen=True)
class RowSetting:
    """One row of the table.

    Attributes:
        row: its name.
        method: what is compensated.
        samples: training rows; 0 is none.
        learner: makes a predictor of a residual; None where nothing is learned.
        physics: makes the model from the declared one and the training rows.
        single_pass: one pseudo-target pass, as in the paper.
        realisable: joints are chosen among the servos' steps, else each is rounded by itself.
        paper: mean |z| (mm) and variance (mm^2) printed in Table I, where it has the row.
    """

    row: str
    method: Method
    samples: int = 0
    learner: Callable[..., Any] | None = None
    physics: Callable[[Model, Session], Model] = lambda declared, _: declared
    single_pass: bool = False
    realisable: bool = True
    paper: tuple[float, float] | None = None


@dataclass(frozen=True)
class Outcome:
    """One row on one arm, errors against the targets in m.

    Attributes:
        tip: of the true tip.
        seen: of the tip as the stereo head reports it without noise (the paper's way).
        fallbacks: targets where no correction was applied (outside the training data, ...).
    """

    row: str
    tip: Errors
    seen: Errors
    fallbacks: int


def ssa_bp(q: np.ndarray, residual: np.ndarray, context: Context, seed: int) -> Any:
    """Return the paper's network: joints in, one member, and it never refuses."""
    made = train(q, residual, None, inputs=_JOINTS_ONLY, hidden=HIDDEN, ensemble=1, seed=seed)
    far = np.full_like(made.encoding.lower, np.inf)
    everywhere = replace(made.encoding, lower=-far, upper=far)
    alone, proven = np.full(3, np.inf), LearnedGain()
    return replace(made, encoding=everywhere, variance_limit=np.inf, alone=alone, gain=proven)


def ssa_bp_best(q: np.ndarray, residual: np.ndarray, context: Context, seed: int) -> Any:
    """Return this package's: joints and context in, an ensemble."""
    return train(q, residual, context, hidden=HIDDEN, ensemble=3, seed=seed)


def gaussian_process(q: np.ndarray, residual: np.ndarray, context: Context, seed: int) -> Any:
    """Return a Gaussian process with the approach direction (common to all joints)."""
    return train_gaussian_process(q, residual, context, seed=seed)


def with_effects(declared: Model, session: Session) -> Model:
    """Calibrate, with the effects found on the training rows (`explain_session`)."""
    base = declared.plus(*geometry_terms(declared.arm, session))
    candidates = list_candidates(declared.arm, session.context(), declared=base.terms).testable
    return explain_session(base, session, candidates).fit.model


def as_printed(
    row: str, method: Method, paper: tuple[float, float], samples: int = 0
) -> RowSetting:
    """Return a row of the paper's Table I, by the paper's scheme."""
    learner = ssa_bp if samples else None
    return RowSetting(
        row, method, samples, learner, lambda declared, _: declared.commandable, bool(samples),
        realisable=False, paper=paper,
    )  # fmt: skip


SETTINGS = (
    as_printed("Original error", Method.NONE, (17.7, 223.94)),
    as_printed("Deflection only", Method.DEFLECTION, (15.39, 215.97)),
    as_printed("SSA-BP only, 900", Method.NETWORK, (5.32, 52.83), 900),
    as_printed("SSA-BP only, 300", Method.NETWORK, (12.66, 214.37), 300),
    as_printed("Deflection + SSA-BP, 900", Method.BOTH, (5.79, 57.15), 900),
    as_printed("Deflection + SSA-BP, 300", Method.BOTH, (9.98, 180.81), 300),
    RowSetting("Deflection + GP with approach, 900", Method.BOTH, 900, gaussian_process),
    RowSetting("Deflection + GP with approach, 300", Method.BOTH, 300, gaussian_process),
    RowSetting("Deflection + SSA-BP with approach, 900", Method.BOTH, 900, ssa_bp_best),
    RowSetting("Deflection + SSA-BP with approach, 300", Method.BOTH, 300, ssa_bp_best),
    RowSetting(
        "Calibrated + effects, 300, rounded", Method.DEFLECTION, 300, physics=with_effects,
        realisable=False,
    ),
    RowSetting("Calibrated + effects, 900", Method.DEFLECTION, 900, physics=with_effects),
    RowSetting("Calibrated + effects, 300", Method.DEFLECTION, 300, physics=with_effects),
    RowSetting("Best: effects + SSA-BP, 900", Method.BOTH, 900, ssa_bp_best, with_effects),
    RowSetting("Best: effects + SSA-BP, 300", Method.BOTH, 300, ssa_bp_best, with_effects),
)  # fmt: skip

PRINTED = tuple(s for s in SETTINGS if s.paper)
"""The paper's own rows."""

COMPARISONS = (
    ("Deflection only", "Original error"),
    ("Deflection + SSA-BP, 300", "SSA-BP only, 300"),
    ("Deflection + SSA-BP, 900", "SSA-BP only, 900"),
    ("Deflection + SSA-BP, 300", "Deflection + SSA-BP, 900"),
    ("Deflection + SSA-BP with approach, 300", "Deflection + GP with approach, 300"),
    ("Deflection + SSA-BP with approach, 300", "Deflection + SSA-BP, 300"),
    ("Best: effects + SSA-BP, 300", "Deflection + SSA-BP with approach, 300"),
    ("Calibrated + effects, 300", "Deflection + GP with approach, 300"),
    ("Calibrated + effects, 900", "Deflection + GP with approach, 900"),
    ("Calibrated + effects, 300", "Calibrated + effects, 300, rounded"),
    ("Best: effects + SSA-BP, 300", "Calibrated + effects, 300"),
    ("Best: effects + SSA-BP, 900", "Calibrated + effects, 900"),
)
"""Pairs of rows whose paired differences are reported."""


def with_steps(arm: Arm, effects: Sequence[Hidden]) -> Arm:
    """Return the arm with the steps of its simulated servos declared."""
    data = arm.model_dump(mode="json", exclude_none=True)
    for effect in effects:
        if isinstance(effect, ServoQuantisation):
            for row, step in zip(arm.commanded, effect.step, strict=True):
                if step:
                    data["joints"][row - 1]["step_deg"] = math.degrees(step)
    return Arm.parse(data, arm.name)


@dataclass(frozen=True)
class Bench:
    """One simulated arm with its measurements and targets."""

    declared: Model
    true: TrueArm
    camera: TrueCamera
    session: Session
    poses: np.ndarray  # (M, 4, 4) targets
    seed_q: np.ndarray  # (M, n) where the arm stands before
    side: np.ndarray  # (M,) side all joints arrive from
    temperature_c: float
    payload_kg: float
    as_paper: bool = False

    @property
    def targets(self) -> np.ndarray:
        """(M, 3) m."""
        return self.poses[:, :3, 3]

    @classmethod
    def draw(
        cls,
        base: Arm,
        seed: int,
        number: int,
        poses: int = max(SAMPLES),
        *,
        as_paper: bool = False,
        also: tuple[str, ...] = (),
    ) -> Bench:
        """Return arm number `number` of a study: geometry, hidden effects, session, targets.

        Args:
            as_paper: every joint arrives from below, always; the grid is measured in its order, so
                that few samples, the last ones, are a corner of it.
            also: names of further hidden effects, of typical size.
        """
        rng = np.random.default_rng([seed, number])
        arm = random_arm(rng, base)
        effects = paper_mix(rng, arm)
        arm = with_steps(arm, effects)
        more = (hidden(name, arm, 1.0, rng) for name in also)
        true, camera = make_truth(arm, (*effects, *more))
        if as_paper:
            whole = paper_grid(arm)
            plan = whole[np.sort(rng.permutation(len(whole))[:poses])]
        else:
            plan = grid(arm, poses, rng).q
        session = measure_session(
            true, camera, plan, rng=rng, approach="below" if as_paper else "random"
        ).session
        declared = declared_model(arm)
        postures = random_joints(arm, TARGETS, rng)
        return cls(
            declared,
            true,
            camera,
            session,
            declared.rigid.pose(postures),
            postures,
            np.ones(TARGETS) if as_paper else rng.choice([-1.0, 1.0], TARGETS),
            float(session.columns["temperature_c"][-1]),
            arm.payload.mass_kg if arm.payload else 0.0,
            as_paper,
        )

    def rows(self, samples: int) -> Session:
        """Return so many training rows: the first, or the last of a grid in its order."""
        total = len(self.session)
        return self.session.take(
            slice(total - samples, total) if self.as_paper else slice(0, samples)
        )

    def run(self, setting: RowSetting, seed: int) -> Outcome:
        """Train a row, command the targets, evaluate the tip."""
        return self.command(setting, *self.train(setting, seed))

    def train(self, setting: RowSetting, seed: int) -> tuple[Model, Any]:
        """Make model and predictor of a row."""
        rows = self.rows(setting.samples)
        model = setting.physics(self.declared, rows)
        predictor = None
        if setting.learner is not None:
            base = model if setting.method.uses_physics else model.rigid
            predictor = setting.learner(*training_rows(base, rows), seed=seed)
        return model, predictor

    def command(self, setting: RowSetting, model: Model, predictor: Any) -> Outcome:
        """Command the targets by a trained row, and evaluate what it leaves."""
        arm = self.declared.arm
        known = Context(
            tuple(self.side for _ in range(arm.n)),
            {"temperature_c": self.temperature_c, "payload_kg": self.payload_kg},
        )
        sent = compensate_arrays(
            model, predictor, self.poses, context=known, seed=self.seed_q,
            method=setting.method, position_only=True,
            single_pass=setting.single_pass, realisable=setting.realisable,
        )  # fmt: skip
        circumstances = sim_context.TrueContext(
            np.repeat(self.side[:, None], arm.n, axis=1), self.temperature_c, self.payload_kg
        )
        tip = self.true.pose(sent.command, circumstances)[:, :3, 3]
        return Outcome(
            setting.row,
            Errors.of(tip - self.targets),
            Errors.of(self.camera.seen(tip) - self.targets),
            sum(map(bool, sent.status)),
        )


def one_arm(
    base: Arm,
    seed: int,
    number: int,
    settings: tuple[RowSetting, ...] = SETTINGS,
    *,
    as_paper: bool = False,
) -> list[Outcome]:
    """Run all rows on one arm."""
    poses = max(s.samples for s in settings) or 1
    bench = Bench.draw(base, seed, number, poses, as_paper=as_paper)
    return [bench.run(setting, seed) for setting in fitted_once(settings)]


def fitted_once(settings: Sequence[RowSetting]) -> list[RowSetting]:
    """Return the rows of one arm; a model that two of them share is fitted once."""
    fitted: dict[int, Model] = {}

    def once(declared: Model, session: Session) -> Model:
        if len(session) not in fitted:
            fitted[len(session)] = with_effects(declared, session)
        return fitted[len(session)]

    return [replace(s, physics=once) if s.physics is with_effects else s for s in settings]


def command_arms(
    base: Arm,
    arms: int,
    seed: int = 0,
    *,
    jobs: int = -1,
    settings: tuple[RowSetting, ...] = SETTINGS,
    as_paper: bool = False,
) -> Iterator[list[Outcome]]:
    """Command every arm and yield its outcomes as they are finished.

    Args:
        base: the declared arm whose variants are built.
        arms: number of arms.
        seed: seed of all random choices; the same seed gives the same table.
        jobs: processes; -1 is one per core.
        settings: rows.
        as_paper: as in `Bench.draw`.

    Raises:
        JobError: joblib is not installed.
    """
    with extra():
        from joblib import Parallel, delayed

    work = (
        delayed(one_arm)(base, seed, number, settings, as_paper=as_paper) for number in range(arms)
    )
    yield from Parallel(n_jobs=jobs, return_as="generator")(work)
