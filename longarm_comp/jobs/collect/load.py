"""The mass at the tool while a plan is measured: as the graph tells it, or as somebody answers."""

import math
from collections.abc import Callable

import numpy as np
from std_msgs.msg import Float64

from longarm_comp.jobs.client import ArmClient
from longarm_comp.jobs.graph_client import GraphClient
from longarm_comp.nodes.interfaces import PAYLOAD

PATIENCE_S = 5.0
"""Longest wait (s) for a payload, which comes about once a second."""
Attach = Callable[[float, int], bool]
"""A function that asks for a mass (kg) for a number of visits; it tells whether the arm has it."""


class Load:
    """Knows the mass at the tool, asks for another one, and publishes what was answered.

    While another node publishes `payload`, its word counts and this class publishes nothing. The
    mass that is `assumed` counts while nobody says one.
    """

    def __init__(self, client: GraphClient, attach: Attach, assumed: float | None = None) -> None:
        self._client, self._attach, self._assumed = client, attach, assumed
        self._told: float | None = None
        self._answered: float | None = None
        self._missing: set[float] = set()
        self._publisher = PAYLOAD.publisher(client.node)
        PAYLOAD.subscription(client.node, self._on_payload)

    def _on_payload(self, message: Float64) -> None:
        self._told = message.data

    def _others_tell(self) -> bool:
        node = self._client.node
        found = node.get_publishers_info_by_topic(self._publisher.topic_name)
        return any(end.node_name != node.get_name() for end in found)

    def waits(self) -> bool:
        """Tell whether another node publishes a mass, but none has come yet."""
        return self._told is None and self._others_tell()

    @property
    def kg(self) -> float | None:
        """The mass at the tool; None if neither another node nor an answer says it."""
        answered = self._assumed if self._answered is None else self._answered
        return self._told if self._others_tell() else answered

    def is_carried(self, kg: float | None) -> bool:
        """Tell whether the arm carries a mass, within 5 % or 20 g; None stands for any mass."""
        now = self.kg
        return kg is None or (now is not None and math.isclose(now, kg, rel_tol=0.05, abs_tol=0.02))

    def change(self, kg: float, visits: int) -> str:
        """Ask for a mass for a number of visits; return "", or that it is missing.

        A mass that was not attached is not asked for again.
        """
        if kg not in self._missing and self._attach(kg, visits):
            self.confirm(kg)
            return ""
        self._missing.add(kg)
        return f"{kg:g} kg at the tool are missing"

    def confirm(self, kg: float) -> None:
        """Take a mass as the one that the arm carries; JobError if another node says another."""
        self._answered = kg
        self.publish()
        self._client.spin(0.2)  # s: what came while somebody answered is heard
        self._client.until(
            lambda: self.is_carried(kg),
            PATIENCE_S,
            lambda: f"`payload` says {self.kg} kg, not {kg:g} kg: who publishes it must agree",
        )

    def publish(self) -> None:
        """Publish the mass that was answered, unless another node publishes one."""
        if self._answered is not None and not self._others_tell():
            self._publisher.publish(Float64(data=self._answered))


def find_carried(client: ArmClient, loads_kg: np.ndarray) -> np.ndarray:
    """Tell for each of N masses whether the arm carries it now, by `payload` or else arm.yaml."""
    declared = client.arm.payload
    assumed = 0.0 if declared is None else declared.mass_kg
    load = Load(client, lambda kg, visits: False, assumed)
    client.wait(lambda: not load.waits(), PATIENCE_S)
    return np.array([load.is_carried(kg) for kg in loads_kg.tolist()])
