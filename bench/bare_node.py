"""A minimal rclpy node with one service, as the reference for the start of nodes."""

from __future__ import annotations

import rclpy
from std_srvs.srv import Trigger


def main() -> None:
    """Start, report readiness and end."""
    rclpy.init()
    node = rclpy.create_node("bare")
    node.create_service(Trigger, "ready", lambda _, response: response)
    print("ready", flush=True)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
