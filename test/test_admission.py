"""Admission: what is refused and with which words, what is only noted, what passes untouched."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from small_arm import ARM, measured

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import Marker
from longarm_comp.core.arm.spatial import rpy_frame
from longarm_comp.core.data.admission import Admission, admit
from longarm_comp.core.data.belonging import MIN_POSES
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.sessions.csv import read_csv


@pytest.fixture
def session(rng: np.random.Generator) -> Session:
    return measured(80, rng)


def refusal(session: Session, arm: Arm = ARM) -> str:
    with pytest.raises(InputError) as caught:
        admit(session, arm)
    return str(caught.value)


def checks(admission: Admission) -> set[str]:
    return {finding.check for finding in admission.findings}


def with_xyz(session: Session, xyz: np.ndarray) -> Session:
    return dataclasses.replace(session, xyz=xyz)


def test_good_session_passes_untouched(session: Session) -> None:
    admission = admit(session, ARM)
    assert admission.session is session
    assert admission.findings == ()


@pytest.mark.parametrize(
    "case", ["paper_twin_900", "none_mid_300", "one_backlash_300", "one_joint_compliance_300"]
)
def test_the_twin_passes(case: str, data_dir: Path) -> None:
    arm = Arm.load(data_dir / "twin" / "arm.yaml")
    for name in ("samples.csv", "test.csv"):
        admission = admit(read_csv(data_dir / "twin" / case / name, arm), arm)
        assert checks(admission) <= {"blanks", "constant", "outliers"}


def test_millimetres(session: Session) -> None:
    assert "this looks like millimetres" in refusal(with_xyz(session, 1e3 * session.xyz))


def test_centimetres(session: Session) -> None:
    assert "this looks like centimetres" in refusal(with_xyz(session, 1e2 * session.xyz))


def test_degrees(session: Session) -> None:
    q = session.q.copy()
    q[:, [0, 1, 3]] = np.degrees(q[:, [0, 1, 3]])
    assert "this looks like degrees" in refusal(dataclasses.replace(session, q=q))
    q = ARM.mid + 0.3 * (session.q - ARM.mid)
    q[:, [0, 1, 3]] = np.degrees(q[:, [0, 1, 3]])
    assert "this looks like degrees" in refusal(dataclasses.replace(session, q=q))
    q = session.q.copy()
    q[:, 0] += np.where(np.arange(len(q)) == 4, 3.0, 0.0)  # within a turn: may be radians
    q[:, 0] *= 0.9 * np.pi / np.abs(q[:, 0]).max()
    message = refusal(dataclasses.replace(session, q=q))
    assert "looks like degrees" not in message and "q1" in message


def test_millimetres_of_stroke(session: Session) -> None:
    q = session.q.copy()
    q[:, 2] *= 1e3
    message = refusal(dataclasses.replace(session, q=q))
    assert "q3" in message
    assert "this looks like millimetres" in message


def test_far_beyond_the_limits(session: Session) -> None:
    q = session.q.copy()
    q[11, 1] = 4.0
    message = refusal(dataclasses.replace(session, q=q))
    assert "row 12, q2: 4.0" in message
    assert "joint2" in message


def test_a_little_beyond_the_limits_is_noted(session: Session) -> None:
    q = session.q.copy()
    q[3, 0] = ARM.upper[0] + 0.01
    (finding,) = admit(Session.record(q, Model(ARM).tip(q)), ARM).findings
    assert finding.check == "limits"
    assert finding.field == "q1"


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
    assert finding.check == "frame"
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
    assert checks(admit(with_xyz(session, session.xyz + np.array([2.0, 0, 0])), ARM)) == {"frame"}


def test_another_arm(session: Session, rng: np.random.Generator) -> None:
    assert "that spread as arm small does" in refusal(with_xyz(session, 4 * session.xyz))
    q = rng.random((9, 3))
    assert "4 commanded joints" in refusal(Session.record(q, np.zeros((9, 3))))


def test_all_blank(session: Session) -> None:
    assert "blank in all 80 rows" in refusal(with_xyz(session, np.full((80, 3), np.nan)))


def test_some_blank_is_noted(session: Session) -> None:
    xyz = session.xyz.copy()
    xyz[:8] = np.nan
    (finding,) = admit(with_xyz(session, xyz), ARM).findings
    assert finding.message == "nothing measured in 8 rows (10%)"


def test_one_row(session: Session) -> None:
    assert "rows: 1; allowed: at least 4 distinct poses" in refusal(session.take([0]))


def test_all_rows_one_pose(session: Session, rng: np.random.Generator) -> None:
    xyz = session.xyz[[0] * 30] + 1e-4 * rng.standard_normal((30, 3))
    still = Session.record(session.q[[0] * 30], xyz)
    assert "poses with a marker: 1" in refusal(still)


def test_copied_rows(session: Session) -> None:
    copied = session.take(np.repeat(np.arange(20), 3))
    copied = dataclasses.replace(copied, index=np.arange(60))
    assert "40 of 60 are copies" in refusal(copied)
    few = session.take([*range(40), 5, 6])
    few = dataclasses.replace(few, index=np.arange(42))
    (finding,) = admit(few, ARM).findings
    assert finding.check == "duplicates"


def test_repeats_with_their_own_measurement_are_fine(
    session: Session, rng: np.random.Generator
) -> None:
    rows = np.repeat(np.arange(20), 3)
    xyz = session.xyz[rows] + 1e-4 * rng.standard_normal((60, 3))
    assert admit(Session.record(session.q[rows], xyz), ARM).findings == ()


def test_frozen_marker_is_noted(session: Session) -> None:
    xyz = session.xyz.copy()
    xyz[30:34] = xyz[29]
    assert "duplicates" in checks(admit(with_xyz(session, xyz), ARM))


def test_index_twice(session: Session) -> None:
    index = session.index.copy()
    index[10] = 9
    assert "index of row 11: 9; allowed: each index once" in refusal(
        dataclasses.replace(session, index=index)
    )


def test_two_markers_may_share_an_index(session: Session) -> None:
    arm = ARM.model_copy(update={"markers": {"a": Marker(frame=4), "b": Marker(frame=4)}})
    both = dataclasses.replace(session, labels={"marker": np.array(["a", "b"] * 40)})
    both = dataclasses.replace(both, index=np.repeat(np.arange(40), 2))
    admit(both, arm)
    wrong = dataclasses.replace(both, labels={"marker": np.array(["a", "c"] * 40)})
    assert "marker: 'c'; allowed: one of a, b" in refusal(wrong, arm)


def test_rows_out_of_order(session: Session) -> None:
    shuffled = session.take(np.random.default_rng(0).permutation(80))
    assert "in the order of recording" in refusal(shuffled)
    clock = dataclasses.replace(session, columns={"t_s": np.arange(80.0)[::-1]})
    assert "t_s of row 2: '78 after 79'" in refusal(clock)
    put_off = dataclasses.replace(shuffled, columns={"t_s": np.arange(80.0)})
    admit(put_off, ARM)  # as `longarm collect` drives the visits to which no way was free at first


def test_joint_that_never_moved_is_noted(session: Session) -> None:
    q = session.q.copy()
    q[:, 2] = 0.05
    (finding,) = admit(Session.record(q, Model(ARM).tip(q)), ARM).findings
    assert (finding.check, finding.field) == ("constant", "q3")


def test_outliers_are_counted(session: Session) -> None:
    xyz = session.xyz.copy()
    xyz[[4, 44]] += [0.2, 0, 0]
    (finding,) = admit(with_xyz(session, xyz), ARM).findings
    assert finding.check == "outliers"
    assert finding.message.startswith("2 gross outliers (2.5%), the worst 200 mm")


def test_sigma_in_millimetres(session: Session) -> None:
    wrong = dataclasses.replace(session, sigma=np.full((80, 3), 0.3))
    assert "sigma_x, sigma_y, sigma_z: 0.3" in refusal(wrong)


def test_impossible_context(session: Session) -> None:
    cold = dataclasses.replace(session, columns={"temperature_c": np.full(80, -300.0)})
    assert "temperature_c: -300.0" in refusal(cold)
    light = dataclasses.replace(session, columns={"payload_kg": np.full(80, -0.1)})
    assert "payload_kg: -0.1" in refusal(light)
