"""Keeps at hand what the next target needs: compiled programs, and a predictor that answers."""

from __future__ import annotations

from collections.abc import Hashable
from functools import partial

from rclpy.node import Node

from longarm_comp.core.compensation.online import StaleContext
from longarm_comp.core.ik import solver as ik
from longarm_comp.core.ik.codegen import Compiled
from longarm_comp.nodes.compensator import Compensator
from longarm_comp.nodes.health import OK, WARN, Report
from longarm_comp.nodes.predictor_client import PredictorClient
from longarm_comp.nodes.ticks import steady_timer
from longarm_comp.nodes.worker import Worker


class Readiness:
    """Prepares on the worker, between targets, whatever has changed since the last look.

    A new model, another method, or a circumstance that is told for the first time needs other
    programs. `Compensator.rehearse` compiles them: it computes a target that nobody asked for.
    """

    def __init__(
        self, node: Node, worker: Worker, compute: Compensator, predictor: PredictorClient,
        *, compiled: bool,
    ) -> None:  # fmt: skip
        self._worker = worker
        self._compute, self._predictor = compute, predictor
        self._compiled = compiled and ik.warm_up()
        self._prepared: Hashable = None
        self._busy = self._probed = False
        steady_timer(node, 0.25, self.look)
        self.look()

    def look(self) -> None:
        """Prepare what is not at hand."""
        needed, _ = self._needed()
        if not self._busy and (needed != self._prepared or not self._predictor.answers):
            self._busy = True  # before the worker can have done it
            if not self._worker.submit(partial(self._prepare, needed)):
                self._busy = False

    def _needed(self) -> tuple[Hashable, str]:
        """What the programs of the next target depend on; why that is not known, or nothing."""
        try:
            return (self._compute.kind() if self._compiled else "not compiled"), ""
        except StaleContext as unknown:
            return self._prepared, str(unknown)

    def _prepare(self, needed: Hashable) -> None:
        try:
            self._predictor.probe()
            self._probed = True
            if needed != self._prepared and self._compiled:
                self._compute.rehearse()
        finally:
            self._prepared = needed  # also after a fault, which every target would repeat
            self._busy = False  # last: the next look would prepare the same again

    def report(self) -> Report:
        """Whether the next target takes its ordinary time, for diagnostics."""
        facts = {"programs compiled": Compiled.programs}
        needed, unknown = self._needed()
        if unknown:
            return Report(WARN, unknown, facts)
        if not self._probed or needed != self._prepared:
            return Report(WARN, "getting ready", facts)
        return Report(OK, "ready", facts)
