"""Converts sightings of the tip from the tracker's frame to the arm's base.

A tracker may stand anywhere. Once a model knows the pose of the tracker's frame, sightings are
published in the base frame on `tip_seen`. The tracker's frame is also published on tf, so that
targets may be given in it. No other module converts between these frames.
"""

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped

from longarm_comp.core.arm.frame_tree import UnknownPlace
from longarm_comp.core.compensation.target_frame import MEASURED, Placement
from longarm_comp.core.model.link_frames import Placed
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.arm_state import ArmState
from longarm_comp.nodes.drawing import ArmFrames
from longarm_comp.nodes.frames import FrameListener, prefix_of
from longarm_comp.nodes.messages import express_sighting


class TipSightings:
    """Receives the sightings on `tip_measured`, and publishes the pose of their frame.

    Attributes:
        unplaced: why sightings are not compared with predictions: the pose of their frame is not
            known. Empty if it is known.
    """

    def __init__(self, state: ArmState, frames: FrameListener, drawn: ArmFrames) -> None:
        self._state, self._frames, self._drawn = state, frames, drawn
        self._measured = prefix_of(state.node) + MEASURED
        self._own = ("", state.base_frame, state.p["base_frame"])
        self._seen_in = self.unplaced = ""
        self._told: Placement | None = None
        self._tips = graph.TIP_SEEN.publisher(state.node)
        self.tell()

    def tell(self) -> None:
        """Publish the pose of the measurements' frame, if the model knows it and it is new."""
        stands = self._state.files.loaded.stands
        if stands is self._told or not stands.solved:
            return
        placed = [Placed.at(self._state.base_frame, self._measured, stands.measurements)]
        if self._seen_in and (self._seen_in in self._drawn.standing or self._is_unknown):
            placed.append(Placed.at(self._measured, self._seen_in, np.eye(4)))
        self._frames.know(placed)
        self._drawn.tell_standing(placed)
        self._told = stands

    @property
    def _is_unknown(self) -> bool:
        """True if tf does not know the pose of the sightings' frame."""
        try:
            self._frames.place(self._seen_in, self._state.base_frame, 0)
        except UnknownPlace:
            return True
        return False

    def take(
        self, message: PoseWithCovarianceStamped
    ) -> tuple[PoseWithCovarianceStamped, PoseWithCovarianceStamped | None]:
        """Publish a sighting on `tip_seen`, in the base frame; unchanged if its place is unknown.

        Return it as published, and in the frame of the model; None if its place is unknown.
        """
        frame, base = message.header.frame_id.lstrip("/"), self._state.base_frame
        if frame not in (self._seen_in, self._measured, *self._own):
            self._seen_in, self._told = frame, None
        self.tell()
        stands, self.unplaced = self._state.files.loaded.stands, ""
        if stands.solved or frame in self._own:
            told, of_model = express_sighting(message, stands.measurements, base), message
        else:
            try:
                told = express_sighting(message, self._frames.place(frame, base, 0), base)
            except UnknownPlace as error:
                self.unplaced = f"tips are not compared before a calibration: {error}"
                told = message
            of_model = None if self.unplaced else told
        self._tips.publish(told)
        return told, of_model
