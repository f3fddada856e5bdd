"""Admission: what is refused and with which words, what is only noted, what passes untouched."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from small_arm import ARM, measured

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import CameraSensor, Inclinometer, Marker
from longarm_comp.core.arm.spatial import rpy_frame
from longarm_comp.core.data.admission import Admission, admit
from longarm_comp.core.data.belonging import MIN_POSES, sample_rows
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import read_csv
from longarm_comp.share import folder


@pytest.fixture
def session(rng: np.random.Generator) -> Session:
    return measured(80, rng)


def refusal(session: Session, arm: Arm = ARM) -> str:
    with pytest.raises(InputError) as caught:
        admit(session, arm)
    return str(caught.value)


def texts(admission: Admission) -> list[str]:
    return [str(finding) for finding in admission.findings]


def with_xyz(session: Session, xyz: np.ndarray) -> Session:
    return dataclasses.replace(session, xyz=xyz)


def test_good_session_passes_untouched(session: Session) -> None:
    admission = admit(session, ARM)
    assert admission.session is session
    assert admission.findings == ()


@pytest.mark.parametrize(
    "case", ["paper_twin_900", "none_mid_300", "one_backlash_300", "one_joint_compliance_300"]
)
def test_the_twin_passes(case: str, data_dir: Path, twin: Arm) -> None:
    for name in ("samples.csv", "test.csv"):
        admission = admit(read_csv(data_dir / "twin" / case / name, twin), twin)
        harmless = ("nothing measured", "never", "gross outliers")
        assert all(any(words in text for words in harmless) for text in texts(admission))


def with_q(session: Session, j: int, change: Callable[[np.ndarray], object]) -> Session:
    """The session with other values of a joint and the tip still where it was."""
    q = session.q.copy()
    q[:, j] = change(q[:, j])
    return dataclasses.replace(session, q=q)


def in_degrees(session: Session, share: float) -> Session:
    """The session with turning joints in degrees, of a share of their ranges."""
    q = ARM.mid + share * (session.q - ARM.mid)
    q[:, [0, 1, 3]] = np.degrees(q[:, [0, 1, 3]])
    return dataclasses.replace(session, q=q)


def filled(session: Session, name: str, value: float) -> Session:
    return dataclasses.replace(session, columns={name: np.full(len(session), value)})


REFUSED: dict[str, Callable[[Session], Session]] = {
    "this looks like millimetres": lambda s: with_xyz(s, 1e3 * s.xyz),
    "this looks like centimetres": lambda s: with_xyz(s, 1e2 * s.xyz),
    "this looks like degrees": lambda s: in_degrees(s, 1.0),
    "(this looks like degrees)": lambda s: in_degrees(s, 0.3),
    "q3.*this looks like millimetres": lambda s: with_q(s, 2, lambda v: 1e3 * v),
    "row 12, q2: 4.0.*joint2": lambda s: with_q(
        s, 1, lambda v: np.where(np.arange(80) == 11, 4.0, v)
    ),
    "that spread as arm small does": lambda s: with_xyz(s, 4 * s.xyz),
    "4 commanded joints": lambda s: Session.record(s.q[:, :3], s.xyz),
    "blank in all 80 rows": lambda s: with_xyz(s, np.full((80, 3), np.nan)),
    "rows: 1; allowed: at least 4 distinct poses": lambda s: s.take([0]),
    "40 of 60 are copies": lambda s: dataclasses.replace(
        s.take(np.repeat(np.arange(20), 3)), index=np.arange(60)
    ),
    "80 of 160 are copies": lambda s: dataclasses.replace(
        s.take(np.tile(np.arange(80), 2)), index=np.arange(160)
    ),
    "index of row 11: 9; allowed: each index once": lambda s: dataclasses.replace(
        s, index=np.where(np.arange(80) == 10, 9, s.index)
    ),
    "in the order of recording": lambda s: s.take(np.random.default_rng(0).permutation(80)),
    "t_s of row 2: '78 after 79'": lambda s: dataclasses.replace(
        s, columns={"t_s": np.arange(80.0)[::-1]}
    ),
    "sigma_x, sigma_y, sigma_z: 0.3": lambda s: dataclasses.replace(s, sigma=np.full((80, 3), 0.3)),
    "temperature_c: -300.0": lambda s: filled(s, "temperature_c", -300.0),
    "t_s: 1.7e\\+18; allowed: .* seconds": lambda s: filled(s, "t_s", 1.7e18),
    "group 'b': '2 rows'; allowed: at least 3": lambda s: dataclasses.replace(
        s, labels={"group": np.where(np.arange(80) < 78, "a", "b")}
    ),
    "payload_kg: -0.1": lambda s: filled(s, "payload_kg", -0.1),
}


@pytest.mark.parametrize("words", REFUSED)
def test_sessions_that_are_refused(words: str, session: Session) -> None:
    assert re.search(words, refusal(REFUSED[words](session)))


def test_a_turn_beyond_the_limits_may_be_radians(session: Session) -> None:
    q = session.q.copy()
    q[:, 0] += np.where(np.arange(len(q)) == 4, 3.0, 0.0)
    q[:, 0] *= 0.9 * np.pi / np.abs(q[:, 0]).max()
    message = refusal(dataclasses.replace(session, q=q))
    assert "looks like degrees" not in message and "q1" in message


def test_a_little_beyond_the_limits_is_noted(session: Session) -> None:
    q = session.q.copy()
    q[3, 0] = ARM.upper[0] + 0.01
    (finding,) = admit(Session.record(q, Model(ARM).tip(q)), ARM).findings
    assert str(finding) == "q1: 1 rows up to 0.01 beyond its limits"


@pytest.mark.parametrize(
    ("order", "signs", "name"),
    [
        ((1, 0, 2), (1, 1, 1), "y,x,z"),
        ((0, 1, 2), (1, -1, 1), "x,-y,z"),
        ((0, 1, 2), (-1, -1, -1), "-x,-y,-z"),
    ],
)
def test_mirrored_axes(
    order: tuple[int, ...], signs: tuple[int, ...], name: str, session: Session
) -> None:
    mirrored = with_xyz(session, session.xyz[:, order] * signs)
    assert "look mirrored" in refusal(mirrored)
    message = refusal(mirrored.take(np.arange(MIN_POSES - 1)))  # too few to try other mistakes
    assert f"axes like {name}" in message
    assert "right-handed" in message


def test_turned_frame_is_noted_with_the_base_that_explains_it(session: Session) -> None:
    base = rpy_frame((0.3, -0.2, 0.1), (0.0, 0.0, np.pi / 2)).matrix()
    turned = session.xyz @ base[:3, :3].T + base[:3, 3]
    (finding,) = admit(with_xyz(session, turned), ARM).findings
    assert "turned by 90 deg against the declared arm, axes like -y,x,z" in finding.message
    words = finding.message.split("as base: ")[1]
    xyz = [float(v) for v in words.split("xyz_m: [")[1].split("]")[0].split(",")]
    rpy = [float(v) for v in words.split("rpy_deg: [")[1].split("]")[0].split(",")]
    assert np.allclose(xyz, [0.3, -0.2, 0.1], atol=2e-3)
    assert np.allclose(rpy, [0, 0, 90], atol=0.2)
    declared = ARM.model_copy(
        update={"base": ARM.base.model_copy(update={"xyz_m": tuple(xyz), "rpy_deg": tuple(rpy)})}
    )
    assert admit(with_xyz(session, turned), Arm.parse(declared.model_dump(), "arm")).findings == ()


def test_moved_frame_is_noted_not_refused(session: Session) -> None:
    (text,) = texts(admit(with_xyz(session, session.xyz + np.array([2.0, 0, 0])), ARM))
    assert "m away from where the declared arm is" in text


def test_some_blank_is_noted(session: Session) -> None:
    xyz = session.xyz.copy()
    xyz[:8] = np.nan
    (finding,) = admit(with_xyz(session, xyz), ARM).findings
    assert finding.message == "nothing measured in 8 rows (10%)"


def test_all_rows_one_pose(session: Session, rng: np.random.Generator) -> None:
    xyz = session.xyz[[0] * 30] + 1e-4 * rng.standard_normal((30, 3))
    still = Session.record(session.q[[0] * 30], xyz)
    assert "poses with a marker: 1" in refusal(still)


def test_one_load_that_the_beams_do_not_carry_is_found_among_many_rows(
    rng: np.random.Generator,
) -> None:
    demo = Arm.load(folder("config") / "arm_demo.yaml")
    assert demo.payload is not None
    payload = demo.payload.model_copy(update={"most_kg": 1e6})
    demo = demo.model_copy(update={"payload": payload})
    q = rng.uniform(demo.lower, demo.upper, (400, demo.n))
    load = np.full(400, 0.25)
    rows = Session.record(q, Model(demo).tip(q), columns={"payload_kg": load})
    among = np.setdiff1d(np.arange(400), sample_rows(rows))[0]
    load[among] = 9e5
    heavy = Session.record(q, rows.xyz, columns={"payload_kg": load})
    with pytest.raises(InputError, match="look at E_pa"):
        admit(heavy, demo)


def test_few_copied_rows_are_noted(session: Session) -> None:
    few = dataclasses.replace(session.take([*range(40), 5, 6]), index=np.arange(42))
    (finding,) = admit(few, ARM).findings
    assert finding.message == "2 repeat pose and measurement to the last digit"


def test_repeats_with_their_own_measurement_are_fine(
    session: Session, rng: np.random.Generator
) -> None:
    rows = np.repeat(np.arange(20), 3)
    xyz = session.xyz[rows] + 1e-4 * rng.standard_normal((60, 3))
    assert admit(Session.record(session.q[rows], xyz), ARM).findings == ()


def test_frozen_marker_is_noted(session: Session) -> None:
    xyz = session.xyz.copy()
    xyz[30:34] = xyz[29]
    text = "x, y, z: 4 rows repeat another pose's measurement exactly"
    assert text in texts(admit(with_xyz(session, xyz), ARM))


def test_two_markers_may_share_an_index(session: Session) -> None:
    arm = ARM.model_copy(update={"markers": {"a": Marker(frame=4), "b": Marker(frame=4)}})
    both = dataclasses.replace(session, labels={"marker": np.array(["a", "b"] * 40)})
    both = dataclasses.replace(both, index=np.repeat(np.arange(40), 2))
    admit(both, arm)
    wrong = dataclasses.replace(both, labels={"marker": np.array(["a", "c"] * 40)})
    assert "marker: 'c'; allowed: one of a, b" in refusal(wrong, arm)


def test_rays_are_seen_by_declared_cameras(session: Session) -> None:
    arm = ARM.model_copy(
        update={
            "sensors": {
                "left": CameraSensor(kind="camera"),
                "level": Inclinometer(kind="inclinometer"),
            }
        }
    )

    def seen_by(sensor: str) -> Session:
        labels = {"sensor": np.full(80, sensor)}
        return dataclasses.replace(session, labels=labels, readings={"ray": session.xyz}, blocks=())

    admit(seen_by("left"), arm)
    for other in ("right", "level"):
        text = f"sensor: '{other}'; allowed: a camera of arm.yaml's sensors (there are: left)"
        assert text in refusal(seen_by(other), arm)


def test_rows_out_of_order_by_their_index_alone_are_admitted(session: Session) -> None:
    """As `longarm collect` drives the visits to which no way was free at first."""
    shuffled = session.take(np.random.default_rng(0).permutation(80))
    admit(dataclasses.replace(shuffled, columns={"t_s": np.arange(80.0)}), ARM)


def test_joint_that_never_moved_is_noted(session: Session) -> None:
    q = session.q.copy()
    q[:, 2] = 0.05
    (finding,) = admit(Session.record(q, Model(ARM).tip(q)), ARM).findings
    assert str(finding) == "q3: never moved: its effects do not show"


def test_outliers_are_counted(session: Session) -> None:
    xyz = session.xyz.copy()
    xyz[[4, 44]] += [0.2, 0, 0]
    (finding,) = admit(with_xyz(session, xyz), ARM).findings
    assert finding.message.startswith("2 gross outliers (2.5%), the worst 200 mm")


@pytest.mark.parametrize(
    ("blank", "rows", "words"),
    [(48, 80, "incl_2_x: left out, 60% blank"), (32, 48, "incl_2_x: 32 rows left out")],
)
def test_an_inclinometer_that_was_mostly_not_read_is_left_out_not_the_rows(
    blank: int, rows: int, words: str, session: Session
) -> None:
    tilt = np.where(np.arange(80) < blank, np.nan, np.linspace(0.0, 0.1, 80))
    given = dataclasses.replace(session, columns={**session.columns, "incl_2_x": tilt})
    admitted = admit(given, ARM)
    assert len(admitted.session) == rows
    assert ("incl_2_x" in admitted.session.columns) == (rows < 80)
    assert any(text.startswith(words) for text in texts(admitted))
