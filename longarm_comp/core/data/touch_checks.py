"""What the touches of a session can tell: checks at its admission."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.admission_finding import AdmissionFinding
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.touched import unknowns
from longarm_comp.core.errors import InputError


def check_touches(session: Session, arm: Arm) -> Iterator[AdmissionFinding]:
    """Its limitations."""
    stood = [kind for kind in KINDS.values() if not kind.cells and kind.label in session.labels]
    for kind in stood:
        texts = session.labels[kind.label]
        lost = (texts != "") & np.isnan(session.reading(kind)[:, 0])
        few = [str(name) for name in np.unique(texts[lost])]
        if few:
            rows = f"{kind.takes + 1} rows or more"
            if not session.seen.any():
                allowed = f"{rows} of one name"
                raise InputError(session.source, kind.label, "each in too few rows", allowed)
            text = f"{', '.join(few)}: in fewer than {rows}, which tells nothing"
            yield AdmissionFinding("touch", kind.label, text)
    stood = [kind for kind in session.kinds if not kind.cells]
    if not stood:
        return
    unknowns(arm, session)
    if len(np.unique(session.labels.get("group", np.array([""])))) > 1 and not any(
        kind.framed(arm) for kind in session.kinds
    ):
        allowed = "one base placement where all is touched: nothing shows how the bases stand"
        raise InputError(session.source, "group", "several", allowed)
    points = {name for kind in stood for name in session.named(kind)}
    for one, other, *_ in session.touch_distances:
        if (one in points) != (other in points):
            text = f"{other if one in points else one} was not touched"
            yield AdmissionFinding("touch", "touch_distances", text)
