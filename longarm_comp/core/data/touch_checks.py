"""What the touches of a session can tell: checks at its admission."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.data.admission_finding import AdmissionFinding
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.touched import unknowns
from longarm_comp.core.errors import InputError


def check_touches(session: Session, arm: Arm) -> Iterator[AdmissionFinding]:
    """Its limitations.

    Raises:
        InputError: nothing was touched more often than it takes to solve where it is, and nothing
            else was measured; distances make a loop; several bases, and nothing shows where they
            stand.
    """
    stood = [kind for kind in session.kinds if not kind.cells]
    if not stood:
        return
    unknowns(arm, session)
    told = len(stood) < len(session.kinds)
    for kind in stood:
        texts = session.labels[kind.label]
        few = [n for n in session.named(kind) if (texts == n).sum() <= kind.takes]
        told = told or len(few) < len(session.named(kind))
        if few:
            rows = f"{kind.takes + 1} rows or more"
            text = f"{', '.join(few)}: touched in fewer than {rows}, which tells nothing"
            yield AdmissionFinding("touch", kind.label, text)
    if not told:
        field = ", ".join(kind.label for kind in stood)
        raise InputError(session.source, field, "each touched too few times", rows)
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
