"""The printed marker that the parameters of `stereo_bridge` describe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from longarm_comp.devices.stereo.target import CharucoTarget, TagBoard


def tags_of(bridge: Mapping[str, Any]) -> TagBoard:
    """A marker of tags, from parameters by dotted name."""
    return TagBoard(
        bridge["marker.tag_m"],
        bridge["marker.gap_m"],
        bridge["marker.columns"],
        bridge["marker.rows"],
        bridge["marker.dictionary"],
        bridge["marker.first_id"],
    )


def marker_of(bridge: Mapping[str, Any]) -> TagBoard | CharucoTarget:
    """The marker, tags or a ChArUco board, from parameters by dotted name."""
    if bridge["marker.kind"] != "charuco":
        return tags_of(bridge)
    return CharucoTarget(
        bridge["marker.square_m"],
        bridge["marker.tag_m"],
        bridge["marker.columns"],
        bridge["marker.rows"],
        bridge["marker.dictionary"],
    )
