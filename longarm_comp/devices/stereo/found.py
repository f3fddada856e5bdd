"""A target's corners in one image, or the reason why there are none."""

from __future__ import annotations

from longarm_comp.devices.stereo.limits import Limits
from longarm_comp.devices.stereo.quality import edge_sigma_px, image_quality
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal
from longarm_comp.devices.stereo.target import Corners, Grey, Target

_MISSING = {"left": RefusalReason.NOT_FOUND_LEFT, "right": RefusalReason.NOT_FOUND_RIGHT}


def found_corners(target: Target, grey: Grey, side: str, limits: Limits) -> Corners:
    """Corners of a target in an image (H, W) of the ``left`` or the ``right`` camera.

    Raises:
        StereoRefusal: AMBIGUOUS, BLURRED; TOO_DARK, TOO_BRIGHT, NOT_FOUND where nothing is seen.
    """
    seen = target.detect(grey)
    if seen.repeated:
        raise StereoRefusal(RefusalReason.AMBIGUOUS, image=side, ids=seen.repeated)
    if not len(seen):
        raise _unseen(grey, side, limits)
    blur = edge_sigma_px(grey, seen.pixels)
    if not blur <= limits.edge_px:
        raise StereoRefusal(RefusalReason.BLURRED, image=side, edge_px=round(blur, 2))
    return seen


def _unseen(grey: Grey, side: str, limits: Limits) -> StereoRefusal:
    look = image_quality(grey)
    facts: dict[str, object] = {
        "image": side, "bright": round(look.bright), "dark": round(look.dark)
    }  # fmt: skip
    if not look.bright >= limits.bright:
        return StereoRefusal(RefusalReason.TOO_DARK, **facts)
    if not look.dark <= limits.dark:
        return StereoRefusal(RefusalReason.TOO_BRIGHT, **facts)
    facts["edge_px"] = round(look.edge_px, 2)
    blurred = not look.edge_px <= limits.edge_px
    return StereoRefusal(RefusalReason.BLURRED if blurred else _MISSING[side], **facts)
