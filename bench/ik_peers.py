"""Inverse kinematics of other libraries, which support only the rigid arm.

Each is set to the tolerance that it needs to reach 1e-5 m.  The class of a library that is not
installed raises ImportError.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.quaternion import from_rotation
from longarm_comp.core.arm.spatial import IDENTITY, roll_pitch_yaw


class Peer(Protocol):
    """A solver of one target."""

    name: str

    def solve(self, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """Joints (n,) for a pose (4, 4), NaN where it gives none."""


def rigid_urdf(arm: Arm) -> str:
    """The arm as URDF, base to tip; every joint must be commanded, as on the demonstration's."""
    parts = [f'<robot name="{arm.name}">', '<link name="row0"/>']
    for k, joint in enumerate(arm.joints):
        frame = IDENTITY.turned_x(float(np.radians(joint.alpha_deg))).along(0, joint.a_m)
        frame = frame.turned_z(float(np.radians(joint.theta_offset_deg))).along(2, joint.d_m)
        rpy = roll_pitch_yaw(frame.matrix()[:3, :3])
        xyz, low_high = " ".join(map(repr, map(float, frame.p))), joint.limits
        parts += [
            f'<joint name="joint{k + 1}" type="{joint.type}">',
            f'<parent link="row{k}"/><child link="row{k + 1}"/><axis xyz="0 0 1"/>',
            f'<origin xyz="{xyz}" rpy="{" ".join(map(repr, rpy))}"/>',
            f'<limit lower="{low_high[0]}" upper="{low_high[1]}" effort="1" velocity="1"/>',
            f'</joint><link name="row{k + 1}"/>',
        ]
    return "\n".join([*parts, "</robot>"])


class Toolbox:
    """roboticstoolbox-python (C++ `ik_LM`, `eval`)."""

    name = "roboticstoolbox-python ik_LM (rigid, tol 1e-12)"

    def __init__(self, arm: Arm) -> None:
        from roboticstoolbox import ET, ETS

        chain: list[Any] = []
        for joint in arm.joints:
            turn, shift = np.radians(joint.alpha_deg), np.radians(joint.theta_offset_deg)
            chain += [ET.Rx(turn), ET.tx(joint.a_m), ET.Rz(shift)]
            if joint.type == "revolute":
                chain += [ET.Rz(qlim=list(joint.limits)), ET.tz(joint.d_m)]
            else:
                chain += [ET.tz(joint.d_m), ET.tz(qlim=list(joint.limits))]
        self.ets: Any = ETS([e for e in chain if e.isjoint or e.param != 0.0])  # type: ignore[operator]

    def solve(self, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """See `Peer`."""
        return np.asarray(self.ets.ik_LM(target, q0=seed, tol=1e-12).q)


class Pinocchio:
    """pinocchio: its example of closed-loop inverse kinematics (Python around C++), in the box."""

    name = "pinocchio CLIK (rigid)"

    def __init__(self, arm: Arm) -> None:
        import pinocchio

        self.package: Any = pinocchio
        self.model = pinocchio.buildModelFromXML(rigid_urdf(arm))
        self.data = self.model.createData()
        self.last = self.model.njoints - 1
        self.lower, self.upper = arm.lower, arm.upper

    def solve(self, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """See `Peer`."""
        pin, model, data, last = self.package, self.model, self.data, self.last
        goal, q = pin.SE3(target), seed.copy()
        for _ in range(200):
            pin.forwardKinematics(model, data, q)
            off = data.oMi[last].actInv(goal)
            error = pin.log(off).vector
            if error @ error < 1e-12:
                break
            J = -pin.Jlog6(off.inverse()) @ pin.computeJointJacobian(model, data, q, last)
            step = J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), error)
            q = np.clip(q - step, self.lower, self.upper)
        return q


class TracIk:
    """TRAC-IK by pytracik, `Speed`."""

    name = "pytracik TRAC-IK Speed (rigid)"

    def __init__(self, arm: Arm) -> None:
        import pytracik

        self.package: Any = pytracik
        speed, tip = pytracik.SolveType.Speed, f"row{len(arm.joints)}"
        self.solver = pytracik.TRAC_IK("row0", tip, rigid_urdf(arm), 0.05, 1e-6, speed)

    def solve(self, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """See `Peer`."""
        found = self.package.ik(self.solver, seed, *target[:3, 3], *from_rotation(target[:3, :3]))
        return np.asarray(found)[-len(seed) :] if len(found) >= len(seed) else seed * np.nan


class RoboPlan:
    """roboplan's SimpleIk."""

    name = "roboplan SimpleIk (rigid, tuned)"

    def __init__(self, arm: Arm) -> None:
        from roboplan import core, simple_ik

        described = core.loadUrdfSceneDescriptionFromXml(rigid_urdf(arm))
        self.core: Any = core
        tip = f"row{len(arm.joints)}"
        self.scene = core.Scene("arm", described)
        self.scene.addGroupFromChain("arm", "row0", tip)
        options = simple_ik.SimpleIkOptions(
            "arm", max_iters=200, max_time=0.05, max_restarts=5, step_size=1.0, damping=1e-6,
            max_linear_error_norm=1e-6, max_angular_error_norm=1e-6, check_collisions=False,
        )  # fmt: skip
        self.solver = simple_ik.SimpleIk(self.scene, options)
        self.names, self.tip = [f"joint{k + 1}" for k in range(arm.n)], tip

    def solve(self, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """See `Peer`."""
        goal = self.core.CartesianConfiguration("row0", self.tip, target)
        start = self.core.JointConfiguration(self.names, seed)
        found = self.core.JointConfiguration(self.names, seed)
        ok = self.solver.solveIk(goal, start, found)
        return np.asarray(found.positions) if ok else seed * np.nan


class IkPy:
    """ikpy (SciPy's least squares around NumPy)."""

    name = "ikpy (rigid)"

    def __init__(self, arm: Arm) -> None:
        from ikpy.chain import Chain

        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "arm.urdf"
            file.write_text(rigid_urdf(arm))
            self.chain: Any = Chain.from_urdf_file(
                str(file), base_elements=["row0"], active_links_mask=[False, *[True] * arm.n]
            )

    def solve(self, target: np.ndarray, seed: np.ndarray) -> np.ndarray:
        """See `Peer`."""
        start = np.concatenate([[0.0], seed])
        found = self.chain.inverse_kinematics_frame(target, start, orientation_mode="all")
        return np.asarray(found)[1 : 1 + len(seed)]
