"""`kinematics` and `error_predictor` in one process, for `longarm up --composed`.

A target then asks the predictor with a call instead of a request over DDS. On the graph both nodes
are as they always are: `predict_error` serves others too.
"""

from __future__ import annotations

from rclpy.executors import SingleThreadedExecutor

from longarm_comp.nodes.error_predictor import ErrorPredictor
from longarm_comp.nodes.kinematics import Kinematics
from longarm_comp.nodes.node import program
from longarm_comp.nodes.predictor_client import LocalCaller
from longarm_comp.nodes.worker import Worker


def nodes(executor: SingleThreadedExecutor) -> tuple[ErrorPredictor, Kinematics]:
    """Both nodes."""
    predictor = ErrorPredictor(executor)

    def caller(worker: Worker) -> LocalCaller:
        return LocalCaller(predictor.answer, predictor.publish, worker.next)

    return predictor, Kinematics(executor, caller)


main = program(nodes)

if __name__ == "__main__":
    main()
