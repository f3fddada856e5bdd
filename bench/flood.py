"""Floods `target_pose`: ``python -m bench.flood RATE SECONDS --ros-args -r __ns:=/a_namespace``."""

from __future__ import annotations

import sys
import time

import rclpy

from bench.arms import demo_arm
from longarm_comp.jobs.path import slow_path
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.messages import pose_message

_BURST_S = 0.01


def main() -> None:
    """Publish at a rate for some seconds, and print how many targets that were."""
    rate, seconds = float(sys.argv[1]), float(sys.argv[2])
    rclpy.init()
    node = rclpy.create_node("flood")
    publisher = graph.TARGET_POSE.publisher(node)
    poses = [graph.TARGET_POSE.type(pose=pose_message(m)) for m in slow_path(demo_arm(), 100)]
    for pose in poses:
        pose.header.frame_id = "base"
    while not publisher.get_subscription_count():
        time.sleep(_BURST_S)
    begin, sent = time.monotonic(), 0
    while (passed := time.monotonic() - begin) < seconds:
        while sent < rate * passed:
            publisher.publish(poses[sent % len(poses)])
            sent += 1
        time.sleep(_BURST_S)
    print(sent)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
