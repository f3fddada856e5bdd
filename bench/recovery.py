"""Times to recover and to end: `kinematics` killed and started again, all nodes stopped."""

from __future__ import annotations

import os
import signal
import threading
import time
from functools import cache

from bench.arms import demo_arm, demo_arm_file
from bench.comparison import Result, alone
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.jobs.client import ArmClient
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import BringUp, running
from longarm_comp.nodes.messages import pose_message
from longarm_interfaces.srv import Compensate

REPEATS = 3
_PATIENCE_S = 300.0


def back_after_kill() -> Result:
    """Time from SIGKILL to the next answer of its service, by a client that was there before."""
    taken, _ = _measure()
    return alone("s", taken, "goal: 5 s")


def end_after_interrupt() -> Result:
    """Time from the supervisor's word until every process of the simulated arm has ended."""
    _, taken = _measure()
    return alone("s", [taken], "goal: 3 s")


@cache
def _measure() -> tuple[list[float], float]:
    """Times of every recovery, and of the end, s."""
    arm, space, taken = demo_arm(), f"longarm_bench_{os.getpid()}", list[float]()
    target = graph.TARGET_POSE.type(pose=pose_message(declared_model(arm).pose(arm.mid)))
    target.header.frame_id = "base"
    asked = Compensate.Request(target=target)
    ended = threading.Event()
    with running(BringUp(demo_arm_file(), sim=True, namespace=space)) as supervisor:
        watch = threading.Thread(target=supervisor.run, args=(ended,), daemon=True)
        watch.start()
        with ArmClient(arm, space) as client:
            service = graph.COMPENSATE.client(client.node)
            client.call(service, asked, _PATIENCE_S, again=True)
            for _ in range(REPEATS):
                before, begun = supervisor.pid("kinematics"), time.monotonic()
                os.kill(before, signal.SIGKILL)

                def anew(before: int = before) -> bool:
                    return supervisor.pid("kinematics") != before

                client.until(anew, _PATIENCE_S, "kinematics")
                client.call(service, asked, _PATIENCE_S, again=True)
                taken.append(time.monotonic() - begun)
        ended.set()
        watch.join()
        begun = time.monotonic()
    return taken, time.monotonic() - begun
