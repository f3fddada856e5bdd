"""A day of work: play grows in one joint, the temperature rises, the payload changes.

The simulated arm is calibrated in the morning and commanded all day, four ways at once on the same
targets: without compensation; calibrated, in the circumstances of the morning; calibrated, told
the temperature and the payload of every move; and the same with the drift monitor, which is fed
what the cameras report of every move.  When the monitor asks, poses are measured, the effects are
identified again, and the operator says yes.  Errors are those of the true tip.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.compensation.arrive import CompensationOptions, compensate_move
from longarm_comp.core.compensation.compensate import rigid
from longarm_comp.core.compensation.drift import Monitor
from longarm_comp.core.compensation.result import Method
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.calibrate import stages
from longarm_comp.core.identify.candidates import library
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.hidden.catalogue import hidden
from longarm_comp.sim.hidden.drives import FrictionHysteresis
from longarm_comp.sim.measure import arrival

HIDDEN = ("joint_gain", "gear_eccentricity", "thermal_growth", "friction_hysteresis")
"""What the arm hides from the morning on; softer beams too where it has beams."""
ROW_H = 16.0 / 3600.0
"""Hours that a measured pose takes."""
_WARM_H = 2.5


@dataclass(frozen=True)
class DaySetting:
    """The day.

    Attributes:
        arm: as declared.
        hours: of work.
        moves: targets an hour.
        rows: poses of the morning's calibration, before work begins.
        again: poses that are measured when the monitor asks.
        warming_k: rise of the temperature, most of it in the first hours.
        payloads_kg: carried in turn, each for an equal part of the day.
        growth_rad: by so much the half play of one joint grows in the middle of the day; it is one
            of the two joints that move the tip most.
        noise_m: of a sighting, each axis.
        kinds: effects that are looked for; all of the catalogue where None.
    """

    arm: Arm
    hours: int = 8
    moves: int = 12
    rows: int = 300
    again: int = 150
    warming_k: float = 12.0
    payloads_kg: tuple[float, ...] = (0.25, 0.5, 0.1, 0.4)
    growth_rad: float = 6e-3
    noise_m: float = 2.5e-4
    kinds: Sequence[type[Effect] | type[Bias]] | None = None

    def temperature_c(self, t_h: np.ndarray | float) -> np.ndarray:
        """At hours since work began; the calibration was before."""
        since = np.asarray(t_h) + self.rows * ROW_H
        return self.arm.reference_temperature_c - self.warming_k * np.expm1(-since / _WARM_H)

    def payload_kg(self, t_h: float) -> float:
        """Carried at hours since work began."""
        turn = int(t_h / self.hours * len(self.payloads_kg))
        return self.payloads_kg[min(turn, len(self.payloads_kg) - 1)]

    def grown(self, t_h: float) -> float:
        """Share of the growth of the play that has happened, by the hour."""
        return float(np.clip((np.floor(t_h) / self.hours - 0.2) / 0.4, 0.0, 1.0))


@dataclass(frozen=True)
class Way:
    """How the arm is commanded.

    Attributes:
        name: in table and figure.
        method: what is compensated.
        told: temperature and payload of the move are known; else those of the morning are taken.
        watched: the drift monitor runs, and what it asks for is done.
    """

    name: str
    method: Method = Method.DEFLECTION
    told: bool = True
    watched: bool = False


WAYS = (
    Way("no compensation", Method.NONE),
    Way("calibrated once", told=False),
    Way("with circumstances"),
    Way("with re-diagnosis", watched=True),
)


@dataclass(frozen=True)
class DayOutcome:
    """One day.

    Attributes:
        t_h: (M,) hours since work began, of every move.
        temperature_c, payload_kg, play_rad: (M,) of the circumstances; half play of the joint
            whose play grows.
        error: (ways, M) distance of the true tip from its target, m.
        asked_h: hours at which the monitor asked for a diagnosis.
        said: what it said each time.
    """

    t_h: np.ndarray
    temperature_c: np.ndarray
    payload_kg: np.ndarray
    play_rad: np.ndarray
    error: np.ndarray
    asked_h: tuple[float, ...]
    said: tuple[str, ...]


class _Truth:
    """The true arm at every hour, and its measurements."""

    def __init__(self, setting: DaySetting, rng: np.random.Generator) -> None:
        self.setting, self.rng = setting, rng
        arm = setting.arm
        names = (*HIDDEN, "link_stiffness") if arm.links else HIDDEN
        self._fixed = [hidden(name, arm, 1.0, rng) for name in names]
        self._worn = int(rng.choice(levers(arm)[:2]))
        self._arms: dict[float, TrueArm] = {}

    def play(self, t_h: float) -> float:
        """Half play of the worn joint, rad."""
        return float(self._lag(t_h)[self._worn])

    def _lag(self, t_h: float) -> np.ndarray:
        (friction,) = (e for e in self._fixed if isinstance(e, FrictionHysteresis))
        more = self.setting.growth_rad * self.setting.grown(t_h)
        return friction.lag + more * np.eye(self.setting.arm.n)[self._worn]

    def tip(self, q: np.ndarray, side: np.ndarray, t_h: float, context: TrueContext) -> np.ndarray:
        """(N, 3) m for commands (N, n) that arrived from sides (N, n)."""
        grown = self.setting.grown(t_h)
        if grown not in self._arms:
            worn = FrictionHysteresis(self._lag(t_h))
            effects: list[HiddenEffect] = [
                worn if isinstance(e, FrictionHysteresis) else e
                for e in self._fixed
                if isinstance(e, HiddenEffect)
            ]
            self._arms[grown] = TrueArm(self.setting.arm, effects, steps=2)
        return self._arms[grown].tip(q, replace(context, approach=side))

    def seen(self, tip: np.ndarray) -> np.ndarray:
        """What the cameras report, (N, 3) m."""
        return tip + self.setting.noise_m * self.rng.standard_normal(tip.shape)

    def session(self, rows: int, t_h: float, payloads: Sequence[float]) -> Session:
        """Poses measured up to t_h, all joints of a pose from one side, payloads in turn."""
        arm, rng = self.setting.arm, self.rng
        q = random_joints(arm, rows, rng)
        side = rng.choice([-1.0, 1.0], rows)
        at = t_h + ROW_H * np.arange(-rows + 1, 1)
        temperature = self.setting.temperature_c(at)
        mass = np.repeat(payloads, -(-rows // len(payloads)))[:rows]
        context = TrueContext(temperature_c=temperature, payload_kg=mass, t_s=3600.0 * at)
        tip = self.tip(q, np.repeat(side[:, None], arm.n, axis=1), t_h, context)
        columns = {"t_s": 3600.0 * at, "temperature_c": temperature, "payload_kg": mass}
        return Session.record(
            q, self.seen(tip), approach=side, columns=columns, source=f"measured at {t_h:.1f} h"
        )


def levers(arm: Arm) -> list[int]:
    """Revolute joints (0-based), those first that move the tip most at mid-range."""
    tip, model = arm.mid, Model(arm)
    moved = np.linalg.norm(model.tip(tip + 1e-3 * np.eye(arm.n)) - model.tip(tip[None]), axis=1)
    turning = [j for j, row in enumerate(arm.commanded) if arm.joints[row - 1].type == "revolute"]
    return sorted(turning, key=lambda j: -moved[j])


@dataclass
class _Arm:
    """The arm as it is commanded one way."""

    way: Way
    model: Model
    sigma: np.ndarray
    q: np.ndarray
    side: np.ndarray
    history: History
    monitor: Monitor = field(default_factory=Monitor)

    def move(
        self, truth: _Truth, target: np.ndarray, t_h: float, context: Context, real: TrueContext
    ) -> np.ndarray:
        """Command a target; returns the true tip, (3,) m."""
        made = compensate_move(
            self.model, None, target, start=self.q, history=self.history,
            context_after=lambda arrived: replace(context, **arrived.fields()),
            position_only=True, options=CompensationOptions(method=self.way.method),
        )  # fmt: skip
        path = np.vstack([self.q, made.move.points])
        sides = arrival(path, np.full(len(path), np.nan))[-1]
        self.side = np.where(sides != 0, sides, self.side)
        self.q, self.history = made.move.q, made.history
        tip = truth.tip(self.q[None], self.side[None], t_h, real)
        if self.way.watched:
            expected = self.model.measured(self.q[None], made.context)
            self.monitor = self.monitor.seen((truth.seen(tip) - expected)[0], self.sigma)
        return np.asarray(tip[0])


def one_day(setting: DaySetting, seed: int, ways: Sequence[Way] = WAYS) -> DayOutcome:
    """Calibrate in the morning and work all day.

    Raises:
        InputError, JobError: as `explain_session`.
    """
    rng = np.random.default_rng([seed, 11])
    truth, arm = _Truth(setting, rng), setting.arm
    morning = truth.session(setting.rows, 0.0, setting.payloads_kg)
    model, sigma = identified(declared_model(arm), morning, setting)
    rest, unknown = arm.mid, History.unknown(arm.n)
    arms = [_Arm(way, model, sigma, rest, np.ones(arm.n), unknown) for way in ways]
    t = (np.arange(setting.hours * setting.moves) + 0.5) / setting.moves
    targets = rigid(declared_model(arm)).tip(random_joints(arm, len(t), rng))
    of_morning = {k: float(np.mean(v)) for k, v in morning.columns.items()}
    error = np.empty((len(arms), len(t)))
    asked: list[tuple[float, str]] = []
    for k, t_h in enumerate(t.tolist()):
        now = {
            "t_s": 3600.0 * t_h,
            "temperature_c": float(setting.temperature_c(t_h)),
            "payload_kg": setting.payload_kg(t_h),
        }
        real = TrueContext(**now)
        for i, each in enumerate(arms):
            context = Context(columns=now if each.way.told else of_morning)
            error[i, k] = np.linalg.norm(
                each.move(truth, targets[k], t_h, context, real) - targets[k]
            )
            verdict = each.monitor.verdict()
            if verdict.drifted:
                asked.append((t_h, verdict.finding))
                fresh = truth.session(setting.again, t_h, [now["payload_kg"]])
                each.model, each.sigma = identified(each.model, fresh, setting)
                each.monitor = Monitor()
    return DayOutcome(
        t,
        setting.temperature_c(t),
        np.array([setting.payload_kg(x) for x in t]),
        np.array([truth.play(x) for x in t]),
        error,
        tuple(h for h, _ in asked),
        tuple(said for _, said in asked),
    )


def identified(known: Model, session: Session, setting: DaySetting) -> tuple[Model, np.ndarray]:
    """What is known fitted again, with what it lacks; and its noise, (3,) m."""
    base = dict(stages(known, session))["geometry"].model
    candidates = library(setting.arm, session.context(), setting.kinds, base.terms)
    found = explain_session(base, session, candidates.testable)
    return found.fit.model, found.fit.sigma


def days(setting: DaySetting, seeds: Sequence[int]) -> Iterator[DayOutcome]:
    """One day a seed, another arm each."""
    for seed in seeds:
        yield one_day(setting, seed)


def table(found: Sequence[DayOutcome], parts: int = 4) -> list[dict[str, object]]:
    """Mean 3-D error of the true tip (mm) by way: each part of the day, the whole, its p95."""
    rows: list[dict[str, object]] = []
    t = found[0].t_h
    edges = np.linspace(0.0, np.ceil(t[-1]), parts + 1)
    errors = 1e3 * np.stack([day.error for day in found])  # (days, ways, moves)
    for i, way in enumerate(WAYS):
        row: dict[str, object] = {"commanded": way.name}
        for low, high in itertools.pairwise(edges):
            chosen = (t >= low) & (t < high)
            row[f"{low:g}-{high:g} h, mm"] = float(errors[:, i, chosen].mean())
        row["day, mm"] = float(errors[:, i].mean())
        row["p95, mm"] = float(np.percentile(errors[:, i], 95))
        rows.append(row)
    return rows
