"""The benchmarks of kinematics run in small; the peers are asked for the same arm."""

import math

import numpy as np
import pytest

from bench import catalogue, compensation, forward, ik_peers, kinematics
from bench.arms import demo_arm
from longarm_comp.core.data.plan import paper_grid
from longarm_comp.core.model.model import Model


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = paper_grid(demo_arm())[::182]
    monkeypatch.setattr(kinematics, "paper_grid", lambda arm: grid)
    for module, names in (
        (kinematics, {"BLOCKS": 2, "PER_BLOCK": 4, "BATCH": 16}),
        (forward, {"COUNT": 32, "REPEATS": 2, "BUILT_IN": {}}),
    ):
        for name, value in names.items():
            monkeypatch.setattr(module, name, value)


ROWS = [
    name
    for name, (place, *_) in catalogue.BENCHMARKS["kinematics"].items()
    if name not in ("ik_single_vs_ikpy", "ik_compile_seconds", "forward_cost")  # long
]
ALIKE = ("compensate_path_240", "compensate_path_15_play")
"""Measured by the code of `compensate_path_15`."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.long] * (n in ALIKE)) for n in ROWS],
)
def test_every_row_has_its_figures(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "compensate_batch_10000":
        row = compensation.compensate_batch_10000(count=16)
    else:
        row = catalogue.run(name)
        assert row["name"] == name
    if row["value"] is None:
        assert "not installed" in row["note"]
        return
    figures = [row["value"], *row["spread"]]
    if row["ratio"] is not None:
        figures += [row["ratio"], row["peer_value"]]
    assert all(math.isfinite(v) and v > 0 for v in figures)
    assert "solved 0" not in row.get("note", "")


def test_machine_code_is_timed_on_the_model_s_own_poses():
    """What `forward_batch_...` times is the deflected arm, not something cheaper."""
    model = kinematics.soft_model(demo_arm())
    q = kinematics.random_joints(model.arm, 32, 1)
    work = forward.machine_forward(model, q)
    work()
    (blocks,) = [
        c.cell_contents for c in work.__closure__ if isinstance(c.cell_contents, np.ndarray)
    ]
    kernel = forward.kernel_of(model, forward.ik.Context().layout)
    tip = blocks[:, kernel.slice("out")][:, :3].swapaxes(1, 2).reshape(-1, 3)
    np.testing.assert_allclose(tip, model.tip(q), rtol=0, atol=1e-12)


def test_the_urdf_is_the_rigid_arm():
    pytest.importorskip("pinocchio")
    arm = demo_arm()
    peer = ik_peers.Pinocchio(arm)
    for q in kinematics.random_joints(arm, 5, 2):
        peer.package.forwardKinematics(peer.model, peer.data, q)
        got = peer.data.oMi[peer.last].homogeneous
        np.testing.assert_allclose(got, Model(arm).pose(q), rtol=0, atol=1e-12)
