"""The simulated arm's own tip, which no camera sees: it judges the demonstration."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PointStamped

from longarm_comp.jobs.client import ArmClient
from longarm_comp.nodes.stamps import stamp_ns


class TrueTip:
    """Listens to `simulated_arm/true_tip`; a `Witness` of `TargetRunner`."""

    def __init__(self, client: ArmClient) -> None:
        self._client = client
        self._heard: list[tuple[int, np.ndarray]] = []
        client.node.create_subscription(PointStamped, "simulated_arm/true_tip", self._hear, 20)

    def _hear(self, message: PointStamped) -> None:
        p = message.point
        self._heard.append((stamp_ns(message.header.stamp), np.array([p.x, p.y, p.z])))
        del self._heard[:-20]

    def __call__(self, after_ns: int) -> np.ndarray:
        """The tip (3,), m, after a time (ns)."""
        self._client.until(
            lambda: self._heard and self._heard[-1][0] > after_ns, 10.0,
            "no true_tip of the simulation",
        )  # fmt: skip
        return self._heard[-1][1]
