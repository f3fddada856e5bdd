"""An arm without our driver that somebody else moves: how its joints came there is not known."""

from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from at_work_arm import JOINT, fitted, true_tip
from nodes_bench import Bench
from quick_arm import quick_arm
from small_arm import ARM
from target_requests import pose

from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.nodes import interfaces as graph
from longarm_interfaces.srv import Compensate


def test_a_joint_that_was_moved_away_and_back_does_not_stand_as_it_came(
    stage: Bench, tmp_path: Path
) -> None:
    """It stands at the other side of its play; without run-ups the next command leaves it there."""
    arm_file, model_file = tmp_path / "arm.yaml", tmp_path / "model.yaml"
    arm_file.write_text(yaml.safe_dump(ARM.model_dump(mode="json", exclude_none=True)))
    save_model(model_file, store(fitted()))
    last: dict[str, np.ndarray] = {}

    def tip(q: np.ndarray, side: np.ndarray) -> np.ndarray:
        true = true_tip(q[None], side[None])[0]
        last.update(q=q, side=side, tip=true)
        return np.asarray(true)

    with quick_arm(ARM, lambda q: True, tip) as arm:
        stage.start(
            "kinematics",
            {
                "arm": arm_file, "model": model_file, "acknowledged": False, "run_up": False,
                "method": "deflection",
            },
        )  # fmt: skip
        client = graph.COMPENSATE.client(stage.node)
        target = fitted().tip(ARM.mid + 0.1 * (ARM.upper - ARM.lower))

        def miss() -> float:
            """Serve the target; by how much the true tip misses it, m."""

            def sent() -> Compensate.Response | None:
                request = Compensate.Request(target=pose(target), position_only=True, execute=True)
                answer = stage.call(client, request)
                return answer if answer.success else None

            answer = stage.spin(sent)
            stage.spin(lambda: np.allclose(last["q"], answer.command.position, atol=1e-9))
            return float(np.linalg.norm(last["tip"] - target))

        told = stage.collect(graph.JOINT_STATES)

        def known_to_be_there() -> None:
            told.clear()
            stage.spin(lambda: len(told) > 9)

        assert miss() < 2e-4
        known_to_be_there()
        q = last["q"]
        beyond = q.copy()
        beyond[JOINT - 1] += 0.1 * last["side"][JOINT - 1]
        arm.stand(beyond)
        arm.stand(q)
        known_to_be_there()
        assert miss() < 2e-4
