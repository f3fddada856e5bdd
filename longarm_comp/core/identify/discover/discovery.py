"""Effects without a name: found in the fitted rows, proven on the sealed hold-out, or left."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.discover import words
from longarm_comp.core.identify.discover.bank import Weighed, weight
from longarm_comp.core.identify.discover.banks import CAMERA
from longarm_comp.core.identify.discover.hold_out import CLEAR, alike, borne_out, shown, worse
from longarm_comp.core.identify.discover.propose import doubts, proposed
from longarm_comp.core.identify.discover.search import SearchedFunctions, first, search
from longarm_comp.core.identify.discover.terms import key_of, terms_of
from longarm_comp.core.identify.linear import Marginal
from longarm_comp.core.identify.minor import smallest
from longarm_comp.core.identify.model_fit import ModelFit
from longarm_comp.core.identify.noise import NoiseEstimate
from longarm_comp.core.identify.proof import Proof, prove
from longarm_comp.core.identify.structure import Structure, examine

FAR = 2.0
"""Terms that leave this many times what the library's effects leave do not come to replace them."""
SIMPLER = 3.0
"""Log odds that effects of the library beside what was found must bring to stay."""
AS_LIKELY = -3.0
"""Log odds from which such a term is as likely as the names: their cause is open."""
TOO_FEW = "the held-out poses are too few to show it by themselves"

Term = Effect | Bias


@dataclass(frozen=True)
class Coefficient:
    """One fitted coefficient: value, 95 % interval and unit."""

    where: str
    function: str
    value: float
    ci95: tuple[float, float]
    unit: str


@dataclass(frozen=True)
class Cause:
    """One cause without a name.

    Attributes:
        terms: as the model holds them.
        where: places that explain it (nearly) alike; the first is the one in the model.
        formula: place, component and function with units.
        reading: what it behaves like.
        domain: range of each quantity in the data; outside, it counts as at the end.
        inputs: names of these quantities.
        amounts: the coefficients.
        log_evidence: on top of the rest, the choice among all candidates paid for.
        tip_m: rms and largest shift of the tip over the fitted rows.
        compensated: whether commands correct for it; never what the camera alone sees.
    """

    terms: tuple[Term, ...]
    where: tuple[str, ...]
    formula: str
    reading: str
    domain: tuple[str, ...]
    inputs: tuple[str, ...]
    amounts: tuple[Coefficient, ...]
    log_evidence: float
    tip_m: tuple[float, float]
    compensated: bool

    @property
    def sentence(self) -> str:
        """The formula, what it amounts to, and what it behaves like."""
        rms, most = (1e3 * v for v in self.tip_m)
        text = f"{self.formula} ({rms:.2f} mm rms at the tip, at most {most:.2f}); {self.reading}"
        if len(self.where) > 1:
            text += f"; {' or '.join(self.where[1:4])} would explain it as well"
        return text


@dataclass(frozen=True)
class Discovery:
    """What was found without a name, and whether unseen poses bear it out.

    Attributes:
        fit: of the model with it.
        noise: as judged with it.
        found: its causes, largest first.
        kept: whether the hold-out shows a gain beyond chance.
        rival: whether it may be the cause instead of the names in `without`: it explains the
            fitted rows as well, and the hold-out does not decide.
        without: names of effects of the library that it makes superfluous.
        proof: hold-out without (`calibrated`) and with it (`with_effects`).
        structure: what is left.
        doubts: what the data cannot tell of it.
        next_q: (M, n) poses that would settle these, rad and m.
    """

    fit: ModelFit
    noise: NoiseEstimate
    found: tuple[Cause, ...]
    kept: bool
    rival: bool
    without: tuple[str, ...]
    proof: Proof
    structure: Structure
    doubts: tuple[str, ...]
    next_q: np.ndarray

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of what its functions depend on."""
        return tuple(dict.fromkeys(name for f in self.found for name in f.inputs))

    @property
    def formulas(self) -> str:
        """What was found, in short."""
        return "; and ".join(cause.formula for cause in self.found)

    @property
    def sentence(self) -> str:
        """What was found, and the hold-out with it."""
        before, after = (self.proof.rows[k].rms for k in ("calibrated", "with_effects"))
        gain = f"held-out rms error {1e3 * before:.2f} -> {1e3 * after:.2f} mm"
        if self.rival:
            text = f"The fitted poses do not tell {' and '.join(self.without)} from a cause"
            return f"{text} without a name: {self.formulas}, nor do the held-out ones ({gain})"
        if not self.kept:
            text = "Functions without a name were found but the hold-out does not bear them out"
            return f"{text} ({gain})"
        each = "; and ".join(f.sentence for f in self.found)
        stead = f" in the place of {', '.join(self.without)}" if self.without else ""
        doubt = f". In doubt: {'; '.join(self.doubts)}" if self.doubts else ""
        return f"Found without a name{stead}: {each}. {gain[0].upper()}{gain[1:]}{doubt}"


def discover(
    base: ModelFit,
    plain: ModelFit | None,
    count: int,
    unseal: Callable[[], Session],
    known: NoiseEstimate | None,
    rng: np.random.Generator,
    say: Callable[[str], None] = lambda _: None,
    seed: int = 0,
) -> Discovery | None:
    """Look for causes without a name in what a fit leaves; None where none matters (`smallest`).

    Args:
        base: fit of everything that has a name.
        plain: fit of the geometry alone, where `base` holds effects of the library: they may be
            stand-ins for something else.
        count: number of candidates of the library; effects of it pay for their choice too.
        unseal: opens the rows of the proof; not called where nothing was found.
        known: noise from repeats, if there are any.
        rng: for bootstrap and permutations.
        say: told what is being looked at.
        seed: of the poses proposed.
    """
    say("functions without a name")
    best = search(base, known, say)
    start = base
    if plain is not None:
        alone = search(plain, known, say, lambda fit: _near(fit, base))
        if alone is not None and _advantage(alone, best, base, plain, count) > -SIMPLER:
            best, start = alone, plain
    if best is None or _worth(best, base) < smallest(base):
        return None
    odds = _advantage(best, None, base, start, count)
    return _proven(best, base, start, odds, unseal(), rng, seed)


def contest(
    base: ModelFit,
    less: ModelFit,
    count: int,
    unseal: Callable[[], Session],
    known: NoiseEstimate | None,
    rng: np.random.Generator,
    say: Callable[[str], None] = lambda _: None,
    seed: int = 0,
) -> Discovery | None:
    """Whether one term explains as well, or clearly better, what named effects explain together.

    Names that only imitate a cause may leave no structure to look into.  The cause itself leaves
    less than they do.  Where it is clearly better with no more parameters it may take their place;
    otherwise it is their rival.  None where unseen poses refute it,
    or where it says of them what the names say and acts at the same part of the arm.

    Args:
        less: fit without the names in question; all else as `discover`.
    """
    say("functions without a name instead of names")
    one = first(less, known, say)
    odds = -math.inf if one is None else _advantage(one, None, base, less, count)
    if one is None or odds < AS_LIKELY:
        return None
    clear = odds >= CLEAR and len(one.fit.slots) <= len(base.slots)
    best = (search(less, known, say) or one) if clear else one
    found = _proven(best, base, less, odds, unseal(), rng, seed)
    same = alike(found.proof, smallest(base)) and not _elsewhere(best, base, less)
    if worse(found.proof) or same:
        return None
    kept = clear and found.kept
    return replace(found, kept=kept, rival=not kept)


def _elsewhere(found: SearchedFunctions, base: ModelFit, less: ModelFit) -> bool:
    """Whether it acts at other parts of the arm than the names in question: the repair differs."""
    arm, held = base.model.arm, {t.key for t in less.model.terms}
    beams = {f"beam {beam.name}": str(beam.row) for beam in arm.links}
    named = {t.where.split(",")[0] for t in base.model.terms if t.key not in held}
    rows = {beams.get(where, where.split(" ")[-1]) for where in named}
    theirs = {p.at.split(" ")[-1] for g in found.groups for p, _ in g.candidate.members}
    return "arm" not in rows and not rows & theirs


def _proven(
    best: SearchedFunctions,
    base: ModelFit,
    start: ModelFit,
    odds: float,
    held_out: Session,
    rng: np.random.Generator,
    seed: int,
) -> Discovery:
    """What was found on top of `start`, and what unseen poses say of it against `base`.

    Args:
        odds: log odds for it against `base` by the fitted rows; all else as `discover`.
    """
    proof = prove(
        {"calibrated": base.model, "with_effects": best.fit.model}, base, best.fit, held_out, rng
    )
    held = {t.name for t in start.model.terms}
    gone = tuple(dict.fromkeys(t.name for t in base.model.terms if t.name not in held))
    structure = examine(best.fit, start, rng)
    hypotheses = [group.candidate for group in best.groups]
    few = () if shown(proof) else (TOO_FEW,)
    return Discovery(
        best.fit,
        best.noise,
        _found(best),
        borne_out(proof, odds, best.noise.rho),
        False,
        gone,
        proof,
        structure,
        (*doubts(best.fit, hypotheses), *few),
        proposed(best.fit, hypotheses, seed),
    )


def _worth(found: SearchedFunctions, base: ModelFit) -> float:
    """RMS length (m) that is explained of what a fit leaves of the rows that count for both.

    Rows set aside that were brought back count too.
    """
    both = (found.fit.weights > 0) & (base.weights > 0) | found.back
    square = [((f.residual[both] * f.metres) ** 2).sum(1).mean() for f in (base, found.fit)]
    return float(np.sqrt(max(square[0] - square[1], 0.0)))


def _near(fit: ModelFit, base: ModelFit) -> bool:
    """Whether what a fit leaves is of the size that the library's effects leave."""
    rms = [np.sqrt(((f.residual * weight(base)) ** 2).sum()) for f in (fit, base)]
    return bool(rms[0] < FAR * rms[1])


def _advantage(
    alone: SearchedFunctions,
    beside: SearchedFunctions | None,
    base: ModelFit,
    less: ModelFit,
    count: int,
) -> float:
    """Log odds for what was found without some effects of the library, against these.

    Args:
        alone: what was found without them; `beside`: what was found beside them.
        base: fit with them; `less`: without.
        count: number of candidates of the library.
    """
    full = beside.fit if beside is not None else base
    sigma = np.minimum(alone.fit.sigma, full.sigma)
    weights = np.minimum(alone.fit.weights, full.weights)
    names = {t.name for t in base.model.terms} - {t.name for t in less.model.terms}
    chosen = [g.candidate.log_prior for g in (beside.groups if beside is not None else ())]
    theirs = _log_evidence(full, sigma, weights) + sum(chosen)
    theirs -= len(names) * math.log(max(count, 1))
    mine = _log_evidence(alone.fit, sigma, weights)
    mine += sum(g.candidate.log_prior for g in alone.groups)
    return float(mine - theirs) + alone.back_evidence - (beside.back_evidence if beside else 0.0)


def _log_evidence(fit: ModelFit, sigma: np.ndarray, weights: np.ndarray) -> float:
    """Of all columns of a fit, linearised, for a given noise and given rows."""
    same = replace(fit, sigma=sigma, weights=weights)
    marginal = Marginal(same.design, same.data)
    size = np.eye(same.design.shape[1]) + same.design.T @ same.design
    return float(-0.5 * same.data @ marginal.py - 0.5 * np.linalg.slogdet(size)[1])


def _found(result: SearchedFunctions) -> tuple[Cause, ...]:
    made = [_one(result, k) for k in range(len(result.groups))]
    return tuple(sorted(made, key=lambda f: -f.tip_m[0]))


def _one(result: SearchedFunctions, k: int) -> Cause:
    group, others = result.groups[k], result.alternatives[k]
    keys = [key_of(t) for t in terms_of(group)]
    slots = {key_of(s.owner): (i, s) for i, s in enumerate(result.fit.slots)}
    held = [slots[key] for key in keys]
    amounts, shift = [], np.zeros(result.fit.residual.shape)
    for (place, function), (i, slot) in zip(group.candidate.members, held, strict=True):
        value = float(getattr(slot.owner, slot.parameter.name))
        error = float(result.fit.standard_errors[i])
        shift = shift + value * result.fit.columns[..., i]
        amounts.append((words.where(place), function.formula, value, error, slot.parameter.unit))
    size = np.linalg.norm(shift * result.fit.metres, axis=1)
    return Cause(
        tuple(slot.owner for _, slot in held),
        tuple(dict.fromkeys(_places(group, others))),
        words.formula(group.candidate, [(v, e, u) for _, _, v, e, u in amounts]),
        words.reading(group.candidate),
        tuple(words.domain(group.candidate)),
        tuple(dict.fromkeys(s.of for f in group.candidate.functions for s in f.factors)),
        tuple(Coefficient(w, f, v, (v - 1.96 * e, v + 1.96 * e), u) for w, f, v, e, u in amounts),
        group.log_evidence,
        (float(np.sqrt((size**2).mean())), float(size.max())),
        all(p.at != CAMERA for p, _ in group.candidate.members),
    )


def _places(group: Weighed, others: Sequence[Weighed]) -> list[str]:
    mine = dict.fromkeys(words.where(p) for p, _ in group.candidate.members)
    others_ = [words.where(o.candidate.members[0][0]) for o in others]
    return [" and ".join(mine), *words.seen_alike(group.candidate), *others_]
