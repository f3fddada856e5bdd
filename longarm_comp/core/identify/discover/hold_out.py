"""What unseen poses say of functions without a name."""

from __future__ import annotations

import math

import numpy as np

from longarm_comp.core.identify.practical import Gain
from longarm_comp.core.identify.proof import ENOUGH_OFF, Proof

CLEAR = math.log(1000.0)
"""Log odds from which on there is no doubt."""
SCEPTIC = 10.0
"""The evidence of fitted rows counts by this much less than that of unseen ones: it supposes that
what is left is white noise, and that the cause is one of those that were tried."""


def shown(proof: Proof) -> bool:
    """Whether unseen poses alone show a gain beyond chance."""
    return proof.better and _gain(proof).ci95[0] > 0


def borne_out(proof: Proof, log_evidence: float, rho: float = 0.0) -> bool:
    """Whether unseen poses bear it out: they show it alone, or with the fitted ones."""
    return helps_between(proof) and (shown(proof) or together(proof, log_evidence, rho))


def together(proof: Proof, log_evidence: float, rho: float = 0.0) -> bool:
    """Whether unseen poses and fitted ones show it together.

    Poses that cannot decide do not overrule strong evidence of the fitted ones, as long as their
    error is smaller with it.  The log odds of both are added.

    Args:
        proof: with (`with_effects`) and without it (`calibrated`).
        log_evidence: of the fitted rows, the choice paid for.
        rho: correlation of successive rows' noise, by which they count less.
    """
    gain = _gain(proof)
    odds = (log_evidence / SCEPTIC + proof.log_odds) * (1.0 - abs(rho)) / (1.0 + abs(rho))
    return gain.after < gain.before and proof.agrees and odds > CLEAR


def helps_between(proof: Proof) -> bool:
    """Whether rows off the levels of a grid, where there are some, are no worse for it."""
    off = proof.off_levels
    before, after = (
        np.linalg.norm(proof.errors[k][off], axis=1) for k in ("calibrated", "with_effects")
    )
    return len(after) < ENOUGH_OFF or bool(after.mean() < before.mean())


def worse(proof: Proof) -> bool:
    """Whether unseen poses show it to be worse, beyond chance."""
    return _gain(proof).ci95[1] < 0


def alike(proof: Proof, limit_m: float) -> bool:
    """Whether both models say the same of unseen poses, as seen and as a command would have it."""
    pairs = (
        np.subtract(e["calibrated"], e["with_effects"]) for e in (proof.errors, proof.commanded)
    )
    return all(float(np.sqrt((gap**2).sum(axis=1).mean())) < limit_m for gap in pairs)


def _gain(proof: Proof) -> Gain:
    return Gain.of(proof.errors["calibrated"], proof.errors["with_effects"])
