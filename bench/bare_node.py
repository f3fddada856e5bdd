"""The floor of a node's start: rclpy, one service, nothing else."""

from __future__ import annotations

import rclpy
from std_srvs.srv import Trigger


def main() -> None:
    """Be ready, say so, and end."""
    rclpy.init()
    node = rclpy.create_node("bare")
    node.create_service(Trigger, "ready", lambda _, response: response)
    print("ready", flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
