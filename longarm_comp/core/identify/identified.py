"""What the fitted rows say: memory of the joints, effects, look-alikes, structure, intervals."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.identify.aliasing import EffectFinding, findings
from longarm_comp.core.identify.candidates import Candidate
from longarm_comp.core.identify.confirm import Confirmed, confirm
from longarm_comp.core.identify.fit import fit
from longarm_comp.core.identify.minor import Minor, settled, smallest
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import from_repeats
from longarm_comp.core.identify.remainder import without_remainders
from longarm_comp.core.identify.search import SearchResult, search
from longarm_comp.core.identify.structure import Structure, examine
from longarm_comp.core.identify.undecided import without_undecided
from longarm_comp.core.identify.wind_up import WindUp, refined, wind_up
from longarm_comp.core.model.model import Model

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Identified:
    """What the training rows say.

    Attributes:
        calibrated: the fit of the geometry alone, with the search's noise and outliers.
        search: the effects that were found.
        findings: the same with their look-alikes.
        structure: what the fit with effects leaves.
        confirmed: intervals and doubts.
        candidates: the library, with the radii that the joints' memory was found to have.
        minor: what does not matter.
        memory: these radii and the length of unrecorded run-ups, where joints remember.
    """

    calibrated: ModelFit
    search: SearchResult
    findings: tuple[EffectFinding, ...]
    structure: Structure
    confirmed: Confirmed
    candidates: tuple[Candidate, ...]
    minor: tuple[Minor, ...]
    memory: WindUp | None


def identify(
    start: Model,
    train: Session,
    rows: Callable[[float], Session],
    candidates: tuple[Candidate, ...],
    rng: np.random.Generator,
    say: Progress,
    stepped: Sequence[type[Effect]] = (),
) -> Identified:
    """Memory of the joints, search, look-alikes, structure left, confirmation.

    Args:
        rows: the training rows with unrecorded run-ups taken to be so long (rad).
        stepped: effects whose steps are scanned.
    """
    say("memory of the joints")
    memory = wind_up(start, rows, candidates)
    if memory is not None:
        candidates, train = memory.candidates(candidates), rows(memory.run_up)
    searched = search(
        start,
        train,
        candidates,
        known_noise=from_repeats(start, train),
        stepped=stepped,
        progress=say,
    )
    if memory is not None:
        searched, memory = refined(searched, memory, rows)
        candidates, train = memory.candidates(candidates), rows(memory.run_up)
    searched, minor = settled(searched, say)
    for step in (without_undecided, without_remainders):
        searched, withdrawn = step(searched, say)
        minor += withdrawn
    say("look-alikes")
    result, found = findings(searched, candidates)
    say("structure")
    noise = result.noise
    weights = result.fit.weights
    calibrated = fit(start, train, sigma=noise.sigma, rho=noise.rho, weights=weights)
    least = 0.0 if found else smallest(result.fit)  # what is too small to name is no structure
    structure = examine(result.fit, calibrated, rng, least)
    parts = [driver.part for driver in structure.drivers]
    result = dataclasses.replace(result, noise=noise.without(result.fit, parts))
    confirmed = confirm(result, list(found), candidates, rng)
    return Identified(calibrated, result, found, structure, confirmed, candidates, minor, memory)
