"""A day of work: play grows in one joint, the temperature rises, the payload changes.

The simulated arm is calibrated in the morning and commanded all day, in several ways at once on the
same targets (`WAYS`).  Where an arm stands still to be measured, the time counts: targets that come
meanwhile are not served.  Errors are those of the true tip at the targets that were served.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.history import History
from longarm_comp.core.arm.moves import run_up_lengths
from longarm_comp.core.at_work.learner import Learner
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.arrive import CompensationOptions, compensate_move
from longarm_comp.core.compensation.result import Method
from longarm_comp.core.data.plan import random_joints
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden.catalogue import hidden
from longarm_comp.sim.hidden.drives import FrictionHysteresis
from studies.simulated import arrival

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
    warming_k: float = 12.0
    payloads_kg: tuple[float, ...] = (0.25, 0.5, 0.1, 0.4)
    growth_rad: float = 6e-3
    noise_m: float = 2.5e-4
    kinds: Sequence[type[Effect] | type[Bias]] | None = None

    def temperature_c(self, t_h: np.ndarray | float) -> np.ndarray:
        """Return it at hours since work began; the calibration was before."""
        since = np.asarray(t_h) + self.rows * ROW_H
        return self.arm.reference_temperature_c - self.warming_k * np.expm1(-since / _WARM_H)

    def payload_kg(self, t_h: float) -> float:
        """Return what is carried at hours since work began."""
        turn = int(t_h / self.hours * len(self.payloads_kg))
        return self.payloads_kg[min(turn, len(self.payloads_kg) - 1)]

    def grown(self, t_h: float) -> float:
        """Return the share of the growth of the play that has happened, by the hour."""
        return float(np.clip((np.floor(t_h) / self.hours - 0.2) / 0.4, 0.0, 1.0))


@dataclass(frozen=True)
class Way:
    """A way to command the arm.

    Attributes:
        name: in table and figure.
        method: what is compensated.
        told: temperature and payload of the move are known; else those of the morning are taken.
        learns: the recursive posterior learns from what the cameras report of every move.
    """

    name: str
    method: Method = Method.DEFLECTION
    told: bool = True
    learns: bool = False


WAYS = (
    Way("no compensation", Method.NONE),
    Way("calibrated once", told=False),
    Way("with circumstances"),
    Way("learning at work", learns=True),
)


@dataclass(frozen=True)
class Stop:
    """The arm is measured for its own sake.

    Attributes:
        way: in which it is commanded.
        hour: since work began.
        said: why.
        poses: that it takes, at `ROW_H` each.
    """

    way: str
    hour: float
    said: str
    poses: int


@dataclass(frozen=True)
class DayOutcome:
    """One day.

    Attributes:
        ways: names of the ways in which the arm was commanded.
        t_h: (M,) hours since work began, of every move.
        temperature_c, payload_kg, play_rad: (M,) of the circumstances; half play of the joint
            whose play grows.
        error: (ways, M) distance of the true tip from its target, m; NaN where it was not served.
        stops: of all ways, in order.
        changes: what the learner found changed: hour and words.
    """

    ways: tuple[str, ...]
    t_h: np.ndarray
    temperature_c: np.ndarray
    payload_kg: np.ndarray
    play_rad: np.ndarray
    error: np.ndarray
    stops: tuple[Stop, ...]
    changes: tuple[tuple[float, str], ...] = ()

    def of(self, way: str) -> np.ndarray:
        """Return (M,) m, errors of one way."""
        return np.asarray(self.error[self.ways.index(way)])

    def stops_of(self, way: str) -> list[Stop]:
        """Return the stops of one way."""
        return [stop for stop in self.stops if stop.way == way]


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
        """Return half play of the worn joint, rad."""
        return float(self._lag(t_h)[self._worn])

    def _lag(self, t_h: float) -> np.ndarray:
        (friction,) = (e for e in self._fixed if isinstance(e, FrictionHysteresis))
        more = self.setting.growth_rad * self.setting.grown(t_h)
        return friction.lag + more * np.eye(self.setting.arm.n)[self._worn]

    def tip(self, q: np.ndarray, side: np.ndarray, t_h: float, context: TrueContext) -> np.ndarray:
        """Return (N, 3) m for commands (N, n) that arrived from sides (N, n)."""
        grown = self.setting.grown(t_h)
        if grown not in self._arms:
            worn = FrictionHysteresis(self._lag(t_h))
            effects = [worn if isinstance(e, FrictionHysteresis) else e for e in self._fixed]
            self._arms[grown] = TrueArm(self.setting.arm, effects, steps=2)
        return self._arms[grown].tip(q, replace(context, approach=side))

    def observe(self, tip: np.ndarray) -> np.ndarray:
        """Return the cameras' reports, (N, 3) m."""
        return tip + self.setting.noise_m * self.rng.standard_normal(tip.shape)

    def session(self, rows: int, t_h: float, payloads: Sequence[float]) -> Session:
        """Measure poses up to t_h as `longarm collect` does, with run-ups; payloads in turn.

        All joints of a pose arrive from one side.
        """
        arm, rng = self.setting.arm, self.rng
        q = random_joints(arm, rows, rng)
        side = rng.choice([-1.0, 1.0], rows)
        at = t_h + ROW_H * np.arange(-rows + 1, 1)
        temperature = self.setting.temperature_c(at)
        mass = np.repeat(payloads, -(-rows // len(payloads)))[:rows]
        context = TrueContext(temperature_c=temperature, payload_kg=mass, t_s=3600.0 * at)
        tip = self.tip(q, np.repeat(side[:, None], arm.n, axis=1), t_h, context)
        columns = {"t_s": 3600.0 * at, "temperature_c": temperature, "payload_kg": mass}
        begun = q - side[:, None] * run_up_lengths(arm)
        return Session.record(
            q, self.observe(tip), approach=side, run_up=begun, columns=columns,
            source=f"measured at {t_h:.1f} h",
        )  # fmt: skip


def levers(arm: Arm) -> list[int]:
    """Return revolute joints (0-based), those first that move the tip most at mid-range."""
    tip, model = arm.mid, Model(arm)
    moved = np.linalg.norm(model.tip(tip + 1e-3 * np.eye(arm.n)) - model.tip(tip[None]), axis=1)
    return sorted(np.flatnonzero(~arm.slides).tolist(), key=lambda j: -moved[j])


@dataclass
class _Arm:
    """The arm as it is commanded one way."""

    way: Way
    model: Model
    q: np.ndarray
    side: np.ndarray
    history: History
    learner: Learner | None = None
    busy_until_h: float = 0.0
    stops: list[Stop] = field(default_factory=list)

    def move(
        self, truth: _Truth, target: np.ndarray, t_h: float, context: Context, real: TrueContext
    ) -> np.ndarray:
        """Command a target; returns the true tip, (3,) m."""
        made = compensate_move(
            self.model, None, target, start=self.q, history=self.history,
            context_after=lambda arrived: replace(context, **arrived.fields()),
            position_only=True, options=CompensationOptions(method=self.way.method),
        )  # fmt: skip
        return self._arrive(truth, made.move.points, t_h, context, real)

    def _arrive(
        self, truth: _Truth, points: np.ndarray, t_h: float, context: Context, real: TrueContext
    ) -> np.ndarray:
        """Drive through points (k, n) and look; returns the true tip, (3,) m."""
        self.history = self.history.after(points, self.q)
        path = np.vstack([self.q, points])
        sides = arrival(path, np.full(len(path), np.nan))[-1]
        self.side = np.where(sides != 0, sides, self.side)
        self.q = points[-1]
        arrived = replace(context, **self.history.fields())
        tip = truth.tip(self.q[None], self.side[None], t_h, real)
        if self.learner is not None:
            seen, variance = truth.observe(tip)[0], np.full(3, truth.setting.noise_m**2)
            self.learner = self.learner.learn(self.q, arrived, seen, variance, 3600.0 * t_h)
            self.model = self.learner.model
        return np.asarray(tip[0])

    def tell_apart(self, truth: _Truth, t_h: float, context: Context, real: TrueContext) -> None:
        """Measure the poses that the learner asks for."""
        assert self.learner is not None
        while (asked := self.learner.request_pose(context)) is not None:
            run_up = asked.q - asked.side * run_up_lengths(self.model.arm)
            self._arrive(truth, np.stack([run_up, asked.q]), t_h, context, real)
            self.stops.append(Stop(self.way.name, t_h, asked.text, 1))
            self.busy_until_h = max(self.busy_until_h, t_h) + ROW_H


def one_day(setting: DaySetting, seed: int, ways: Sequence[Way] = WAYS) -> DayOutcome:
    """Calibrate in the morning and work all day.

    Raises:
        InputError, JobError: as `explain_session`.
    """
    rng = np.random.default_rng([seed, 11])
    truth, arm = _Truth(setting, rng), setting.arm
    morning = truth.session(setting.rows, 0.0, setting.payloads_kg)
    fitted = identify(declared_model(arm), morning, setting)
    rest, unknown = arm.mid, History.unknown(arm.n)
    arms = [_Arm(way, fitted.model, rest, np.ones(arm.n), unknown) for way in ways]
    for each in arms:
        if each.way.learns:
            each.learner = Learner.of(with_uncertainty(fitted))
    t = (np.arange(setting.hours * setting.moves) + 0.5) / setting.moves
    targets = declared_model(arm).rigid.tip(random_joints(arm, len(t), rng))
    of_morning = {k: float(np.mean(v)) for k, v in morning.columns.items()}
    error = np.full((len(arms), len(t)), np.nan)
    for k, t_h in enumerate(t.tolist()):
        now = {
            "t_s": 3600.0 * t_h,
            "temperature_c": float(setting.temperature_c(t_h)),
            "payload_kg": setting.payload_kg(t_h),
        }
        real = TrueContext(**now)
        for i, each in enumerate(arms):
            if t_h < each.busy_until_h:
                continue
            context = Context(columns=now if each.way.told else of_morning)
            tip = each.move(truth, targets[k], t_h, context, real)
            error[i, k] = np.linalg.norm(tip - targets[k])
            if each.learner is not None:
                each.tell_apart(truth, t_h, context, real)
    return DayOutcome(
        tuple(way.name for way in ways),
        t,
        setting.temperature_c(t),
        np.array([setting.payload_kg(x) for x in t]),
        np.array([truth.play(x) for x in t]),
        error,
        tuple(stop for each in arms for stop in each.stops),
        tuple(
            (version.at_s / 3600.0, version.named.text)
            for each in arms
            if each.learner is not None
            for version in each.learner.versions
            if version.named is not None
        ),
    )


def identify(known: Model, session: Session, setting: DaySetting) -> ModelFit:
    """Fit what is known again, with what it lacks."""
    base = dict(fit_stages(known, session))["geometry"].model
    candidates = list_candidates(setting.arm, session.context(), setting.kinds, base.terms)
    return explain_session(base, session, candidates.testable).fit
