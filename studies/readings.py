"""The use of joint readings: names of droop and softness, the tip without a camera, trim."""

import itertools
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance as SoftJoint
from longarm_comp.core.effects.compliances import ServoDroop
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.identify.model_tolerance import TOLERANCES
from longarm_comp.core.identify.posterior.found import CREDIBLE, FoundEffect
from longarm_comp.core.identify.posterior.offer_bank import OfferBank
from longarm_comp.core.identify.posterior.offers import make_offers
from longarm_comp.core.model.by_readings import by_readings
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.strict_yaml import read_yaml
from longarm_comp.devices.follower_report import Event, EventKind
from longarm_comp.devices.joint_path import JointTrajectory, TrajectoryPoint
from longarm_comp.devices.servo_arm import ServoArm
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.servo_follower import TrajectoryFollower
from longarm_comp.share import folder
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.cameras import CameraPair, tag_plate
from longarm_comp.sim.context import TrueContext
from longarm_comp.sim.hidden import drives
from longarm_comp.sim.hidden.base import HiddenEffect
from longarm_comp.sim.hidden.catalogue import draw
from longarm_comp.sim.hidden.loads import JointCompliance
from longarm_comp.sim.plant import Plant, PlantConfig, mount_plate
from longarm_comp.sim.servo_emulator.joints import read_arm
from longarm_comp.sim.servo_emulator.motor import MotorSpec
from studies.commands import Figures, Show, study_command, whole_number
from studies.simulated import TrueEncoders, measure_session
from studies.true_camera import TrueCamera, draw_geometry_errors

SIZE_MM = 8.0
"""Shift of the tip, as in the demonstration."""
PLANTED = (("servo_droop",), ("joint_compliance",), ("servo_droop", "joint_compliance"))
PAYLOADS_KG = (0.0, 0.5)
"""That the sessions carry by turns: of one load, a soft joint moves the tip as bent links do."""
JOINTS = (2, 4, 5, 6)
"""All that a load turns, of the demonstration arm."""
RIGHT, MORE = "right and alone", "with a joint too many"
SET, WRONG = "in a true set", "wrong"
SAID = (RIGHT, MORE, SET, WRONG)
"""What a diagnosis says of a case: every true name alone at its joint; there and at another joint;
every true name in a set and nothing beside; or else."""


def names(arm: Arm, cases: int, share: float = 0.3, rows: int = 120) -> Iterator[dict[str, Any]]:
    """Yield a row a case: planted at one joint, at a share of the size; what the diagnosis says.

    Besides what that is (`SAID`): whether the servos' names are right.
    """
    for k in range(cases):
        planted, joint = PLANTED[k % 3], JOINTS[k // 3 % len(JOINTS)]
        rng = np.random.default_rng([26, k])
        effects = [at_joint(joint, name, arm, share * SIZE_MM, rng) for name in planted]
        found = diagnose(arm, measure(arm, effects, rng, rows))
        said = [(f.names, list(f.where)) for f in found.findings]
        want = [((name,), [f"joint {joint}"]) for name in planted]
        servos = [one for one in said if "servo_droop" in one[0]]
        sets = [set(names) for names, _ in said]
        each = all(set(planted) & names for names in sets) and len(sets) == len(planted)
        true = each and set.union(*sets) >= set(planted)
        more = true and all(len(n) == 1 and f"joint {joint}" in w for n, w in said)
        right = sorted(said) == sorted(want)
        yield {
            "case": k,
            "planted": " + ".join(planted),
            "joint": joint,
            "said": "; ".join(f"{'/'.join(n)} {', '.join(w)}" for n, w in said) or "nothing",
            "verdict": found.verdict,
            "is": RIGHT if right else MORE if more else SET if true else WRONG,
            "servo": servos == [one for one in want if one[0] == ("servo_droop",)],
        }


def softness(arm: Arm, share: float = 0.3) -> Iterator[dict[str, Any]]:
    """Yield a row a soft joint and session: how sure its name is on average over the noise.

    `name` is its probability among all names, `rival` the next, both with their priors.
    """
    sessions = [(120, PAYLOADS_KG[1]), (480, PAYLOADS_KG[1]), (480, 4 * PAYLOADS_KG[1])]
    for joint, (rows, load_kg) in itertools.product(JOINTS, sessions):
        rng = np.random.default_rng([26, joint])
        hidden = at_joint(joint, "joint_compliance", arm, share * SIZE_MM, rng)
        assert isinstance(hidden, JointCompliance)
        session = measure(arm, [hidden], rng, rows, load_kg)
        soft = SoftJoint(joint, compliance=float(hidden.compliance[arm.commanded.index(joint)]))
        fitted = fit_model(declared_model(arm).plus(soft, *geometry_terms(arm, session)), session)
        kinds = list_candidates(arm, session.context()).testable
        there = (FoundEffect.of((soft,), 1.0, 0.0),)
        every = make_offers(fitted, kinds, (), there, TOLERANCES)
        of = max(every, key=lambda each: each.evidence_of_known)
        bank, own = of.bank, of.bank.offers[of.known[0]]
        (k,) = own.column_numbers
        seen = bank.gram[:, k] * (soft.compliance / of.widths[k])
        clean = OfferBank(bank.offers, bank.gram, seen, bank.coefficients)
        worth: dict[str, float] = {}
        for offer in bank.offers:
            worth[offer.name] = max(worth.get(offer.name, -np.inf), clean.evidence([offer]))
        worth.pop("servo_droop", None)  # the readings say
        top = worth["joint_compliance"]
        odds = {name: float(np.exp(min(value - top, 50.0))) for name, value in worth.items()}
        rival = max((name for name in odds if name != own.name), key=lambda name: odds[name])
        yield {
            "joint": joint,
            "rows": rows,
            "payloads_kg": f"0, {load_kg:g}",
            "name": round(1.0 / sum(odds.values()), 3),
            "rival": f"{rival} {odds[rival] / sum(odds.values()):.3f}",
        }


def measure(
    arm: Arm,
    effects: Sequence[HiddenEffect],
    rng: np.random.Generator,
    rows: int,
    load_kg: float = PAYLOADS_KG[1],
) -> Session:
    """Measure a simulated arm with wrong geometry too, empty and loaded, its motors read."""
    true = TrueArm(arm, [*effects, *draw_geometry_errors(arm, 1.0, rng)], steps=4)
    zero = rng.normal(0.0, 1e-3, arm.n)
    q = sobol(arm, rows, rng).q
    return measure_session(
        true, TrueCamera.of(arm), q, rng=rng, encoders=TrueEncoders(zero=zero),
        payload_kg=rng.choice([PAYLOADS_KG[0], load_kg], rows),
    ).session  # fmt: skip


def at_joint(
    joint: int, name: str, arm: Arm, size_mm: float, rng: np.random.Generator
) -> HiddenEffect:
    """Return droop or softness of one joint, of a size at the tip."""
    place = np.array([float(row == joint) for row in arm.commanded])
    made: HiddenEffect = JointCompliance(1e-3 * place)
    if name == "servo_droop":
        made = drives.ServoDroop(1e-3 * place)
    poses = rng.uniform(arm.lower, arm.upper, (60, arm.n))
    sound = TrueArm(arm, steps=2).tip(poses)
    for _ in range(8):
        moved = TrueArm(arm, [made], steps=2).tip(poses) - sound
        made = made.scale_by(1e-3 * size_mm / float(np.sqrt((moved**2).sum(1).mean())))
    return made


def tip(arm: Arm, rows: int = 150) -> dict[str, Any]:
    """Return the error of the tip by command and by readings, mm, of servos that droop and stick.

    The model knows neither: it was fitted to the same arm's geometry and readings.
    """
    rng = np.random.default_rng(26)
    droop, friction = (draw(n, arm, rng, 3.0) for n in ("servo_droop", "friction_hysteresis"))
    true = TrueArm(arm, [droop, friction, *draw_geometry_errors(arm, 1.0, rng)], steps=4)
    q = sobol(arm, rows, rng).q
    measured = measure_session(true, TrueCamera.of(arm), q, rng=rng, encoders=TrueEncoders())
    session = measured.session
    terms = (*(ServoDroop(row) for row in ServoDroop.rows(arm)), *geometry_terms(arm, session))
    model = fit_model(declared_model(arm).plus(*terms), session).model
    q = sobol(arm, 100, rng).q
    side = np.repeat(rng.choice([-1.0, 1.0], (100, 1)), arm.n, axis=1)
    context, known = TrueContext(approach=side), Session.record(q, 0 * q[:, :3], approach=side)
    want = true.tip(q, context)
    read = TrueEncoders().read(true.shafts(q, context), rng)
    at = known.context()
    by_command = np.linalg.norm(model.tip(q, at) - want, axis=1).mean()
    by_reading = np.linalg.norm(by_readings(model).tip(read, at) - want, axis=1).mean()
    return {
        "by_command_mm": round(1e3 * float(by_command), 3),
        "by_readings_mm": round(1e3 * float(by_reading), 3),
        "ratio": round(float(by_reading / by_command), 3),
    }


class SaggingArm:
    """The demonstration arm on its emulated bus, in a time of its own; its servos give way.

    Its encoders are off by a zero, and coarser than its controllers.

    Args:
        folder: of the demonstration's files.
        scratch: folder for the bus's link.
        trim: whether its driver trims.
        off: zero of the encoders, ticks.
    """

    def __init__(self, folder: Path, scratch: Path, trim: bool, off: float = 0.0) -> None:
        self.arm = arm = Arm.load(folder / "arm_demo_steps.yaml")
        data = read_yaml(folder / "servo_driver.yaml")["/**/servo_driver"]["ros__parameters"]
        data["bus"]["port"] = str(scratch / "bus")
        servos = ServoConfig.parse({k: data[k] for k in ("bus", "joints", "follower")}, "study")
        turns = np.array([float(j.type == "revolute") for j in arm.joints])
        config = PlantConfig(
            arm,
            read_arm(folder / "servo_driver.yaml"),
            CameraPair(position_m=(0.75, -1.7, 0.3), optical_axis=(0.0, 1.0, 0.0)),
            tag_plate(0.06, 0.012, 2, 2),
            mount_plate([0.0, 0.0, 0.0]),
            (drives.ServoDroop(2.3e-3 * turns), drives.ServoDeadband(3e-4 * turns, 0.05)),
            MotorSpec(encoder_zero_ticks=off),
        )
        self.now = 0.0
        self.plant = Plant(config, scratch / "bus", np.random.default_rng(1), lambda: self.now)
        self.plant.start()
        self.driver = ServoArm(servos, TrajectoryFollower(servos, trim=trim))
        self.driver.power(True)
        self._sound = TrueArm(arm, (), steps=2)

    def cycle(self) -> tuple[Event, ...]:
        """Run another cycle and return what the driver said."""
        self.now += 0.04
        said = self.driver.cycle(self.now).step.events
        self.plant.tip_pose(0.0)
        return said

    def move(self, q: np.ndarray, watch: Callable[[], object] = lambda: None) -> Event:
        """Send it to joints (n,): how the move ended. What it is to be watched for is called."""
        ends = {EventKind.ARRIVED, EventKind.SHORT, EventKind.FAULT}
        self.cycle()
        points = (TrajectoryPoint(1.0, tuple(q.tolist())),)
        self.driver.accept(JointTrajectory(self.arm.joint_names, points), self.now)
        while True:
            said = [e for e in self.cycle() if e.kind in ends]
            watch()
            if said:
                return said[0]

    def miss(self, q: np.ndarray) -> float:
        """Return the tip's distance (m) from where stiff joints (n,) would bring it."""
        want = self._sound.tip(q, TrueContext(payload_kg=0.0)).ravel()
        return float(np.linalg.norm(self.plant.tip_pose(0.0)[:3, 3] - want))

    def close(self) -> None:
        """Switch it off."""
        self.driver.close()
        self.plant.stop()


def run_moves(folder: Path, scratch: Path, moves: int, trim: bool) -> dict[str, Any]:
    """Run moves of an arm whose servos droop by 8 mm: true miss (mm) and time (s)."""
    rig, off, took = SaggingArm(folder, scratch, trim), [], []
    steps = rig.arm.steps
    for q in np.round(sobol(rig.arm, moves + 1, np.random.default_rng(2)).q[1:] / steps) * steps:
        began = rig.now
        rig.move(q)
        took.append(rig.now - began)
        off.append(rig.miss(q))
    rig.close()
    return {
        "trim": trim,
        "mean_mm": round(1e3 * float(np.mean(off)), 3),
        "max_mm": round(1e3 * max(off), 3),
        "mean_s": round(float(np.mean(took)), 2),
    }


@study_command(
    whole_number("--cases", 60, "Planted cases.", least=0),
    whole_number("--moves", 8, "Trimmed moves."),
)
def command(cases: int, moves: int, show: Show) -> Figures:
    """Show what joint readings improve: names of effects, the tip without a camera, trim.

    \b
    Example:
      longarm study readings --cases 6
    """
    config = folder("config")
    arm = Arm.load(config / "arm_demo.yaml")
    by_tip = tip(arm)
    with tempfile.TemporaryDirectory() as scratch:
        trim = [run_moves(config, Path(scratch), moves, on) for on in (False, True)]
    named, soft = list(names(arm, cases)), list(softness(arm))
    sure = {row["joint"]: row["name"] >= CREDIBLE for row in reversed(soft)}  # the first stays
    apart = [r["planted"] == "servo_droop" or sure[r["joint"]] for r in named]
    counts = []
    for said, wanted in (("yes", True), ("no", False)):
        mine = [r["is"] for r, one in zip(named, apart, strict=True) if one is wanted]
        row = {"rows": f"tell them apart: {said}", "n": len(mine)}
        counts.append(row | {key: mine.count(key) for key in SAID})
    servos = sum(r["servo"] for r in named)
    return Figures(
        {
            "tip": by_tip,
            "trim": trim,
            "names": named,
            "counts": counts,
            "servo": servos,
            "softness": soft,
        },
        {
            "The tip of servos that droop and stick": [by_tip],
            "Servos that droop by 8 mm": trim,
            "How sure the name of a soft joint can be": soft,
            "Names": named,
            f"Names, all together; the servos' are right in {servos} of {cases}": counts,
        },
    )
