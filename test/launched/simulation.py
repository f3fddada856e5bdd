"""The simulation's launch file under the real `launch`: `launch_test test/launched/simulation.py`.

It needs a ROS 2 installation and this package in it; `launch_testing` is in no registry.
"""

import time
import unittest

import launch_testing
import rclpy
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch_testing.actions import ReadyToTest
from launch_testing.asserts import assertExitCodes

from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import SIMULATED
from longarm_comp.share import folder

PATIENCE_S = 120.0


def generate_test_description():
    """The launch file, and the tests as soon as its processes are started."""
    source = PythonLaunchDescriptionSource(str(folder("launch") / "simulation.launch.py"))
    return LaunchDescription([IncludeLaunchDescription(source), ReadyToTest()])


class TestGraph(unittest.TestCase):
    """While it runs."""

    def test_every_node_reports(self):
        """All of them on /diagnostics."""
        rclpy.init()
        node, heard = rclpy.create_node("listener"), set()
        graph.DIAGNOSTICS.subscription(
            node, lambda array: heard.update(s.name.strip("/").split(":")[0] for s in array.status)
        )
        until = time.monotonic() + PATIENCE_S
        while not heard.issuperset(SIMULATED) and time.monotonic() < until:
            rclpy.spin_once(node, timeout_sec=0.2)
        node.destroy_node()
        rclpy.shutdown()
        assert set(SIMULATED) <= heard


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    """After it was shut down."""

    def test_every_node_ended_by_itself(self, proc_info):
        """No process had to be killed, none died."""
        assertExitCodes(proc_info)
