"""Whole poses on an arm that is really commanded: the orientation error of its true tip.

The truth turns the tip by joint zeros, a tilted row and compliant joints.  The model knows them; it
imports nothing of the truth.
"""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.compensation.result import Method, Prediction
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.geometry_errors import DhError, JointZero
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden import geometry, loads
from studies.many import compensate_arrays

ZEROS = {1: 0.03, 4: -0.04, 5: 0.05, 6: -0.03}  # rad, by row
TILT = 0.02  # rad, twist of row 5
COMPLIANCE = {2: 0.006, 5: 0.02}  # rad/(N m), by row


@pytest.fixture(scope="module")
def truth(arm: Arm) -> TrueArm:
    def by_row(values: dict[int, float]) -> np.ndarray:
        return np.array([values.get(row, 0.0) for row in arm.commanded])

    tilt = np.zeros((4, len(arm.joints)))
    tilt[0, 4] = TILT
    return TrueArm(
        arm,
        [
            geometry.JointZero(by_row(ZEROS)),
            geometry.DhError(tilt),
            loads.JointCompliance(by_row(COMPLIANCE)),
        ],
    )


@pytest.fixture(scope="module")
def found(arm: Arm) -> Model:
    """What a diagnosis would have found: the same causes, by the package's own physics."""
    return declared_model(arm).plus(
        *(JointZero(joint=row, offset=value) for row, value in ZEROS.items()),
        DhError(row=5, alpha=TILT),
        *(JointCompliance(joint=row, compliance=value) for row, value in COMPLIANCE.items()),
    )


@pytest.fixture(scope="module")
def joints(arm: Arm) -> np.ndarray:
    share = np.random.default_rng(5).uniform(0.25, 0.75, (15, arm.n))
    return np.array(arm.lower + share * (arm.upper - arm.lower))


def turn(reached: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(N, 3) rotation vector in the base frame from wanted to reached, rad."""
    one, other = (Rotation.from_matrix(pose[:, :3, :3]) for pose in (reached, wanted))
    return np.asarray((one * other.inv()).as_rotvec())


def size(vectors: np.ndarray) -> float:
    """Mean length."""
    return float(np.linalg.norm(vectors, axis=1).mean())


def commanded(model: Model, targets: np.ndarray, joints: np.ndarray) -> np.ndarray:
    made = compensate_arrays(model, None, targets, seed=joints, method=Method.DEFLECTION)
    assert made.success.all(), made.reason
    return made.command


def test_the_true_tip_takes_the_commanded_orientation(
    arm: Arm, truth: TrueArm, found: Model, joints: np.ndarray
) -> None:
    targets = declared_model(arm).rigid.pose(joints)
    before = truth.pose(commanded(declared_model(arm), targets, joints))
    after = truth.pose(commanded(found, targets, joints))
    assert size(turn(before, targets)) > 40e-3
    assert size(turn(after, targets)) < 1.5e-3
    assert size(before[:, :3, 3] - targets[:, :3, 3]) > 15e-3
    assert size(after[:, :3, 3] - targets[:, :3, 3]) < 0.5e-3


def test_the_pseudo_target_turns_against_the_expected_error_in_the_base_frame(
    arm: Arm, truth: TrueArm, found: Model, joints: np.ndarray
) -> None:
    """What the declared arm is sent to is the target, turned back by the true arm's error."""
    declared = declared_model(arm)
    targets = declared.pose(joints)
    command = commanded(found, targets, joints)
    sent_to = declared.pose(command)
    error = Rotation.from_rotvec(turn(truth.pose(command), sent_to))
    wanted = Rotation.from_matrix(targets[:, :3, :3])

    def missed(pseudo: Rotation) -> float:
        return size((Rotation.from_matrix(sent_to[:, :3, :3]) * pseudo.inv()).as_rotvec())

    assert missed(error.inv() * wanted) < 1.5e-3
    assert missed(error * wanted) > 80e-3  # the wrong sign: twice the error
    assert missed(wanted * error.inv()) > 20e-3  # the wrong frame: the tip's


@pytest.mark.parametrize("kind", [JointZero, DhError, JointCompliance])
def test_a_cause_with_the_wrong_sign_turns_the_tip_the_wrong_way(
    kind: type, arm: Arm, truth: TrueArm, found: Model, joints: np.ndarray
) -> None:
    """Every cause counts: each one alone, turned round, is seen at the true tip."""
    targets = declared_model(arm).rigid.pose(joints)
    turned = dataclasses.replace(
        found,
        effects=tuple(
            e.with_values({p.name: -getattr(e, p.name) for p in e.declared()})
            if isinstance(e, kind)
            else e
            for e in found.effects
        ),
    )
    after = truth.pose(commanded(turned, targets, joints))
    assert size(turn(after, targets)) > 10e-3


def test_a_learned_error_is_a_position_and_leaves_the_orientation_to_the_physics(
    arm: Arm, found: Model, joints: np.ndarray
) -> None:
    class Known:
        """Expects 3 mm in x everywhere."""

        def predict(self, q: np.ndarray, context: object = None) -> Prediction:
            error = np.tile([3e-3, 0.0, 0.0], (len(q), 1))
            return Prediction(error, np.full((len(q), 3), 1e-4), np.ones(len(q), bool))

    targets = found.pose(joints)
    made = compensate_arrays(found, Known(), targets, seed=joints)
    assert made.success.all(), made.reason
    reached = found.pose(made.command)
    np.testing.assert_allclose(reached[:, :3, 3], targets[:, :3, 3] - [3e-3, 0.0, 0.0], atol=2e-6)
    assert size(turn(reached, targets)) < 1e-6
