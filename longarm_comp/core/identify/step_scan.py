"""Searches for servo steps of unknown size: tries every step of every joint that data could show.

A servo that stands at whole steps errs by ``round(q/step) step - q``.  Over the joint's positions
this is a saw-tooth with no parameter but the step, so thousands of steps are scored by one product
with the residual.  The best one becomes a candidate, whose price includes the choice among them
(`Effect.price`).  With few positions a step looks like other functions of the joint, so such joints
are left out.  The residual may still hold other effects, so a step must explain more than it would
with random signs of the rows.
"""

import numpy as np

from longarm_comp.core.arm import stacked
from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.model_fit import ModelFit, prior_widths
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import JointZero
from longarm_comp.core.identify.discover.functions import REFINED
from longarm_comp.core.identify.discover.inputs import FINE_GRID
from longarm_comp.core.model.model import slots_of

COARSEST, FINEST = 12, 5000
"""Smallest and largest number of steps in a joint's range. With coarser steps they look like any
function of the joint; the finest are a twentieth of a degree in 250 degrees."""
POSITIONS = COARSEST + COARSEST
"""Number of positions at which a joint must have stood: two on each of the coarsest steps."""
APART = 0.25
"""Difference of the numbers of steps that are tried first: at the end of the range they differ by
this share of a step."""


def scan_steps(fitted: ModelFit, kind: type[Effect], need: float) -> tuple[Candidate, ...]:
    """Return the best step of each joint that has none in the model, as a candidate.

    Args:
        fitted: the fit of the geometry and the found effects.
        kind: the effect class (`Effect.of_step`).
        need: log evidence that a step must have after its price is subtracted.
    """
    arm, kept, columns = fitted.model.arm, fitted.weights > 0, FitColumns(fitted)
    marginal = columns.marginal_without(())
    have = {joint for t in fitted.model.effects if isinstance(t, kind) for joint in t.joints}
    rows = [row for row in arm.commanded if row not in have]
    motions = [JointZero(row) for row in rows]
    moved = columns.prior_columns(motions) / prior_widths(slots_of(arm, motions))
    found = []
    for row, column in zip(rows, np.moveaxis(moved, -1, 0), strict=True):
        q = fitted.session.q[kept, arm.commanded.index(row)]
        span = float(np.ptp(q))
        if span == 0.0 or len(np.unique(np.round(q / span, 6))) < POSITIONS:
            continue
        white = span * fitted.whiten_columns(column[..., None])[:, 0].reshape(len(q), -1)
        counts = _best_steps(q / span, white, marginal.projected_data.reshape(white.shape))
        turns = q / span * counts[:, None]
        shifts = _rounding_errors(turns) / counts[:, None]  # (B, M) of the range
        white = (white * shifts[..., None]).reshape(len(counts), -1).T
        terms = [kind.of_step(arm, row, span / count) for count in counts.tolist()]
        projected = marginal.project(white)
        gain = (projected * (marginal.y[:, None] - 0.5 * white)).sum(0)
        each = (white * marginal.projected_data[:, None]).reshape(len(q), -1, len(counts)).sum(1)
        chance = 0.5 * each.sum(0) ** 2 / np.maximum((each**2).sum(0), 1e-300)
        worth = np.minimum(gain, chance) - [term.price(arm) for term in terms]
        best = int(np.argmax(worth))
        if worth[best] >= need:
            found.append(Candidate(kind.name, (terms[best],), scanned=True))
    return tuple(found)


def _best_steps(share: np.ndarray, white: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Return the (B,) best numbers of steps in the range; overlap with the geometry is ignored.

    Here `share` (M,) are positions in units of the range, `white` (M, d) the whitened motion by the
    whole range, and `left` (M, d) the whitened residual.
    """
    along, size = (white * left).sum(1), 0.5 * (white**2).sum(1)

    def gain(counts: np.ndarray, digits: type = float) -> np.ndarray:
        teeth = _rounding_errors(np.outer(counts.astype(digits), share.astype(digits)))
        first = teeth @ along.astype(digits)
        square = np.square(teeth, out=teeth) @ size.astype(digits)
        return np.asarray((first - square / counts) / counts)

    counts = np.arange(COARSEST, FINEST, APART)
    parts = map(np.array, stacked.parts(counts, len(share)))  # larger ones leave the cache
    # Single precision is good to a ten thousandth of a step
    gains = np.concatenate([gain(part, np.float32) for part in parts])
    inner = gains[1:-1]
    peaks = 1 + np.flatnonzero((inner >= gains[:-2]) & (inner >= gains[2:]))
    first = counts[peaks[np.argsort(-gains[peaks])[:REFINED]]]
    near = first[:, None] + np.linspace(-APART, APART, FINE_GRID)
    best = gain(near.reshape(-1)).reshape(near.shape).argmax(axis=1)
    return np.asarray(near[np.arange(len(near)), best])


def _rounding_errors(turns: np.ndarray) -> np.ndarray:
    """Return the change by rounding numbers of steps to whole ones, in steps."""
    whole = np.rint(turns)
    return np.subtract(whole, turns, out=whole)
