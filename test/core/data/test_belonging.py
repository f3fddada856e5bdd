"""Rows that do not belong to the arm are refused, with what its user probably got wrong."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from few_effects import names_alone
from scipy.spatial.transform import Rotation
from small_arm import ARM as SMALL

import longarm_comp as la
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.quaternion import from_rotation
from longarm_comp.core.calibration.calibrate import fit_stages
from longarm_comp.core.data.admission import admit
from longarm_comp.core.data.belonging import MIN_POSES, find_mistake, undo_mistakes
from longarm_comp.core.data.measurement import compute_tip_errors
from longarm_comp.core.data.registration import Sightings, register
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.placements import BasePose
from longarm_comp.core.effects.plays import FrictionHysteresis
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.core.model.model import Model
from studies.coverage import ROWS
from studies.loop_cases import NAMES, Case
from studies.loop_setting import set_up
from studies.real_sessions import laser_tracked

Spoil = Callable[[Session], Session]
ANYWHERE = BasePose("", 12.0, -15.0, 4.0, 0.7, -1.1, 1.84)


@pytest.fixture(scope="module")
def session(demo: Arm) -> Session:
    """A sagging arm with a joint's zero off, seen from far away."""
    rng = np.random.default_rng(5)
    q = rng.uniform(demo.lower, demo.upper, (150, demo.n))
    truth = Model(demo, (ANYWHERE, LinkDeflection(), JointZero(2, offset=8e-3)))
    return Session.record(q, truth.tip(q) + 3e-4 * rng.standard_normal((150, 3)))


def with_q(session: Session, q: np.ndarray) -> Session:
    return dataclasses.replace(session, q=q)


def joint(j: int, change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def spoil(session: Session) -> Session:
        q = session.q.copy()
        q[:, j] = change(q[:, j])
        return with_q(session, q)

    return spoil


def shift(rows: int) -> Spoil:
    return lambda s: dataclasses.replace(s, xyz=np.roll(s.xyz, rows, axis=0))


def swap(j: int, k: int) -> Spoil:
    def spoil(session: Session) -> Session:
        q = session.q.copy()
        q[:, [j, k]] = q[:, [k, j]]
        return with_q(session, q)

    return spoil


def couple(j: int, k: int, factor: float, own: float = 1.0) -> Spoil:
    """Rows of a controller whose joint j keeps its angle to what joint k carries."""

    def spoil(session: Session) -> Session:
        q = session.q.copy()
        q[:, j] = own * q[:, j] + factor * q[:, k]
        return with_q(session, q)

    return spoil


def moved_from(row: int) -> Spoil:
    late = np.arange(150)[:, None] >= row
    turned = Rotation.from_euler("z", 20, degrees=True)
    return lambda s: dataclasses.replace(
        s, xyz=np.where(late, np.add(turned.apply(np.array(s.xyz)), (0.3, 0.0, 0.1)), s.xyz)
    )


WRONG = {
    r"q1 looks negated: \d+ -> \d+(\.\d+)? mm": joint(0, np.negative),
    r"q6 looks negated: ": joint(5, np.negative),
    r"q4 looks offset by a quarter turn: ": joint(3, lambda v: v + np.pi / 2),
    r"q5 looks offset by half a turn: ": joint(4, lambda v: v + np.pi),
    r" -> 26\.\d mm, so more is wrong, or it is something else": joint(5, lambda v: 0.5 * v),
    r"q4 and q6 look swapped: ": swap(3, 5),
    r"q2 and q4 look swapped: ": swap(1, 3),
    r"x, y, z look written one row later than their joints: ": shift(1),
    r"x, y, z look written one row earlier than their joints: ": shift(-1),
    r"q4 looks coupled with q2: the joint is q4 - q2: ": couple(3, 1, 1.0),
    r"q6 looks coupled with q4: the joint is -q6 \+ q4: ": couple(5, 3, 1.0, -1.0),
    r"row 91 on looks measured from another base, or of another arm: \S+ -> \d": moved_from(90),
    r"0, 0, 0 in 6 rows at several poses": lambda s: dataclasses.replace(
        s, xyz=np.where(np.isin(np.arange(len(s)), np.arange(3, 150, 28))[:, None], 0.0, s.xyz)
    ),
    r"x, y, z look mirrored": lambda s: dataclasses.replace(s, xyz=s.xyz[:, [1, 0, 2]]),
    r"as if shuffled": lambda s: dataclasses.replace(
        s, xyz=np.random.default_rng(0).permutation(s.xyz)
    ),
    r"of the rows are far off the others": lambda s: dataclasses.replace(
        s,
        xyz=s.xyz
        + np.where(np.arange(len(s))[:, None] % 2, 0.3, 0.0)
        * np.random.default_rng(1).standard_normal((len(s), 3)),
    ),
}


AGAIN = [text for text in WRONG if "q6 looks negated" in text or "q2 and q4" in text]
"""Second forms of a mistake."""


def wide(arm: Arm) -> Arm:
    """With limits that refuse nothing."""
    data = arm.model_dump(mode="json", exclude_defaults=True)
    for row in data["joints"]:
        if row["type"] == "revolute":
            row["limits_deg"] = [-400, 400]
    return Arm.parse(data, "wide")


def test_rows_of_the_arm_are_admitted(demo: Arm, session: Session) -> None:
    admit(session, wide(demo))


@pytest.mark.parametrize(
    "text", [pytest.param(t, marks=[pytest.mark.long] * (t in AGAIN)) for t in WRONG]
)
def test_a_mistake_is_named_wherever_the_arm_stands(demo: Arm, session: Session, text: str) -> None:
    arm = wide(demo)
    with pytest.raises(InputError, match=text):
        admit(WRONG[text](session), arm)


def test_rows_on_two_sides_of_friction_are_explained_not_refused(demo: Arm) -> None:
    """Half of them stray from the rigid arm; they share how their joints came."""
    number = NAMES.index("friction_hysteresis")
    friction = set_up(
        Case("single", (NAMES[number],), False, "usual", "sobol", ROWS, 1.0, number, 0), demo
    )
    rows = admit(friction.train.take(np.arange(ROWS // 2)), friction.arm).session
    kinds = (FrictionHysteresis, JointGain)
    with names_alone():
        found = diagnose(friction.arm, rows, test=friction.held_out, kinds=kinds)
    assert [f.names for f in found.findings] == [("friction_hysteresis",)]


def test_no_command_takes_rows_that_do_not_belong(rng: np.random.Generator) -> None:
    q = rng.uniform(SMALL.lower, SMALL.upper, (60, 4))
    rows = Session.record(q, Model(SMALL).tip(q) + 1e-4 * rng.standard_normal((60, 3)))
    for command in (la.calibrate, la.train, la.diagnose):
        with pytest.raises(InputError, match="q2 looks negated"):
            command(wide(SMALL), joint(1, np.negative)(rows))


@pytest.mark.parametrize(
    ("name", "texts"),
    [
        ("ur5", ("q1 looks negated", "one row later")),
        pytest.param("ur5", ("q2 and q4 look swapped", "shuffled"), marks=pytest.mark.long),
        pytest.param(
            "wam",
            ("q1 looks negated", "q2 and q4 look swapped", "one row later", "shuffled"),
            marks=pytest.mark.long,
        ),
    ],
)
def test_real_rows_are_told_from_spoilt_ones(
    data_dir: Path, name: str, texts: tuple[str, ...]
) -> None:
    (part,) = laser_tracked(data_dir, name)
    arm, rows = wide(part.arm), part.train
    admit(rows, arm)
    admit(part.test, arm)
    for text in texts:
        spoil = next((s for known, s in WRONG.items() if text in known), None)
        assert spoil is not None
        with pytest.raises(InputError, match=text):
            admit(spoil(rows), arm)


@pytest.mark.parametrize(
    ("name", "last"), [("wam", "q7"), pytest.param("ur5", "q6", marks=pytest.mark.long)]
)
def test_a_sign_that_does_not_move_the_tip_is_said_to_be_untold(
    data_dir: Path, name: str, last: str
) -> None:
    """Negated, the last joint of either arm calibrates as well on unseen rows."""
    (part,) = laser_tracked(data_dir, name)
    unknown = "its sign does not show"
    said = [f for f in admit(part.train, part.arm).findings if unknown in f.message]
    assert [f.field for f in said] == [last]
    axes = np.array([from_rotation(m[:3, :3]) for m in Model(part.arm).pose(part.train.q)])
    posed = Session.record(part.train.q, part.train.xyz, readings={"orientation": axes})
    assert not any(unknown in f.message for f in admit(posed, part.arm).findings)  # axes show it
    negated = joint(part.arm.n - 1, np.negative)
    left = []
    for train, test in ((part.train, part.test), (negated(part.train), negated(part.test))):
        *_, (_, fitted) = fit_stages(Model(part.arm), train)
        left.append(np.linalg.norm(compute_tip_errors(fitted.model, test), axis=1).mean())
    assert left[1] == pytest.approx(left[0], rel=0.02)


def test_no_mistake_explains_real_or_simulated_rows_better(data_dir: Path) -> None:
    """No false alarm, and by far: the nearest mistake leaves all of the misfit."""
    arm = Arm.load(data_dir / "twin" / "arm.yaml")
    for case in ("none_mid_300", "paper_twin_300", "one_backlash_300"):
        rows = la.read_session(data_dir / "twin" / case / "samples.csv", arm)
        some = rows.take(np.arange(0, len(rows), 4))
        own = register(Sightings.of(Model(arm), some)).misfit
        tried = [
            register(Sightings.of(Model(arm), rows)).misfit for _, rows in undo_mistakes(arm, some)
        ]
        assert min(tried) > 0.95 * own


def test_few_rows_are_not_asked(session: Session, demo: Arm) -> None:
    assert find_mistake(Model(demo), session.take(np.arange(MIN_POSES - 1))) is None
    assert find_mistake(Model(demo), session.take(np.arange(MIN_POSES))) is not None


def test_joints_beyond_their_limits_are_told_what_fits(rng: np.random.Generator) -> None:
    q = rng.uniform(SMALL.lower, SMALL.upper, (40, 4))
    rows = Session.record(q, Model(SMALL).tip(q))
    with pytest.raises(InputError, match="q2 looks negated"):
        admit(joint(1, np.negative)(rows), SMALL)
    with pytest.raises(InputError, match="q2 and q3 look swapped"):
        admit(swap(1, 2)(rows), SMALL)
    with pytest.raises(InputError, match=r"q4.*looks like degrees"):
        admit(joint(3, np.degrees)(rows), SMALL)


@pytest.mark.parametrize(("noise_m", "told"), [(0.025, True), (0.03, False)])
def test_a_mistake_is_told_where_it_explains_much_of_the_misfit(
    demo: Arm, noise_m: float, told: bool
) -> None:
    """Joint 6 is negated, under noise: without that 0.68 and 0.76 of the misfit are left."""
    rng = np.random.default_rng(5)
    q = rng.uniform(demo.lower, demo.upper, (100, demo.n))
    xyz = Model(demo).tip(q) + noise_m * rng.standard_normal((100, 3))
    rows = joint(5, np.negative)(Session.record(q, xyz))
    belief = find_mistake(Model(demo), rows)
    assert belief is not None and bool(belief.mistake) == told


def part_of(session: Session, share: float, spoil: Spoil) -> Session:
    """Spoil some rows of a session."""
    spoilt = np.random.default_rng(2).random(len(session)) < share
    made = spoil(session)
    return dataclasses.replace(
        session,
        q=np.where(spoilt[:, None], made.q, session.q),
        xyz=np.where(spoilt[:, None], made.xyz, session.xyz),
    )


PARTS = {
    "q1 looks negated": joint(0, np.negative),
    "x and y look swapped": lambda s: dataclasses.replace(s, xyz=s.xyz[:, [1, 0, 2]]),
    "y looks negated": lambda s: dataclasses.replace(s, xyz=s.xyz * (1.0, -1.0, 1.0)),
}


@pytest.mark.parametrize(
    ("text", "share"),
    [
        *((text, 0.25) for text in PARTS),
        ("q1 looks negated", 0.08),
        pytest.param("x and y look swapped", 0.08, marks=pytest.mark.long),
        pytest.param("y looks negated", 0.08, marks=pytest.mark.long),
    ],
)
def test_a_mistake_in_a_part_of_the_rows_is_told(
    demo: Arm, session: Session, text: str, share: float
) -> None:
    """No fit believes these rows; a quarter of them was once taken for gross errors."""
    with pytest.raises(InputError, match=rf"{text}.* in \d+ of the \d+ rows that are far off"):
        admit(part_of(session, share, PARTS[text]), demo)


@pytest.mark.parametrize(("mistaken", "told"), [(0, False), (12, False), (24, True)])
def test_gross_errors_come_right_by_no_mistake(
    demo: Arm, session: Session, mistaken: int, told: bool
) -> None:
    """Eighteen rows are anywhere; beside them some are mistaken."""
    off = 0.3 * np.random.default_rng(4).standard_normal((len(session), 3))
    off[: len(session) - 18] = 0.0
    rows = PARTS["x and y look swapped"](session)
    xyz = np.where(np.arange(len(session))[:, None] < mistaken, rows.xyz, session.xyz) + off
    belief = find_mistake(Model(demo), dataclasses.replace(session, xyz=xyz))
    assert belief is not None and bool(belief.mistake) == told


@pytest.mark.parametrize("seed", range(4))
def test_a_mistake_is_not_told_where_chance_brings_some_rows_nearer(
    demo: Arm, session: Session, seed: int
) -> None:
    """Three rows are a little farther off than an arm that is not calibrated."""
    off = np.random.default_rng(seed).standard_normal((3, 3))
    xyz = session.xyz.copy()
    xyz[:3] += 0.02 * off / np.linalg.norm(off, axis=1, keepdims=True)
    belief = find_mistake(Model(demo), dataclasses.replace(session, xyz=xyz))
    assert belief is not None and len(belief.strays.rows) >= 3 and not belief.mistake


READ = {
    "look w, x, y, z read as x, y, z, w": lambda q: np.roll(q, 1, axis=1),
    "look x, y, z, w read as w, x, y, z": lambda q: np.roll(q, -1, axis=1),
    "look inverted: the base in the tool": lambda q: q * (-1.0, -1.0, -1.0, 1.0),
    "look w, x, y, z read as x, y, z, w and inverted: the base in the tool": lambda q: (
        np.roll(q, 1, axis=1) * (-1.0, -1.0, -1.0, 1.0)
    ),
    "are not those of the tip": lambda q: np.random.default_rng(0).permutation(q),
}


@pytest.mark.parametrize("text", READ)
def test_axes_in_another_order_are_told(rng: np.random.Generator, text: str) -> None:
    """Also where the body sits anyhow on the tip; its own axes are admitted."""
    q = rng.uniform(SMALL.lower, SMALL.upper, (40, 4))
    truth = Model(SMALL, (ANYWHERE,))
    axes = Rotation.from_matrix(truth.pose(q)[:, :3, :3]) * Rotation.from_euler("x", 1.1)
    made = Session.record(q, truth.measured(q), readings={"orientation": axes.as_quat()})
    assert not any(f.field.startswith(("rows", "qx")) for f in admit(made, SMALL).findings)
    wrong = {"orientation": READ[text](axes.as_quat())}
    with pytest.raises(InputError, match=rf"qx, qy, qz, qw {text}: \d\S+ -> \d\S+ mrad"):
        admit(dataclasses.replace(made, readings=wrong), SMALL)
