"""Scores of a diagnosis against the truth."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from longarm_comp.core.calibration.calibrate import declared_model, geometry_terms
from longarm_comp.core.calibration.candidates import Term, list_candidates
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import BUILT_IN, LIBRARY
from longarm_comp.core.effects.effect import Bias, Effect
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.findings import Finding
from longarm_comp.core.model.model import Model
from studies.loop_setting import LoopSetting
from studies.loop_truth import places, values

ALIKE = 10.0
"""Loss in noise-free log likelihood below which another explanation counts as equivalent.

With noise the log likelihood of such a pair differs by 10 +- 4.5: within the 3 that the
diagnosis calls undecided about once in twenty times.
"""
TWINS = tuple(
    frozenset({kind.name, other})
    for kind in LIBRARY
    for other in (*kind.aliases, *kind.limit_aliases)
)
"""Pairs of names of the same physics, as the effects declare them."""


def score(setting: LoopSetting, found: Diagnosis) -> dict[str, Any]:
    """Compute all scores that the tables use, as plain JSON; lengths in mm."""
    true = set(setting.case.effects)
    names = [set(f.names) for f in found.findings]
    knowable = true <= {kind.name for kind in LIBRARY}
    best = true_fit(setting) if knowable else None
    errors = _errors(setting, found, best)
    said = [
        n | {p.name for p in f.partial_aliases} for n, f in zip(names, found.findings, strict=True)
    ]
    covered = all(any(t in n for n in said) for t in true)
    sets = [f for f in found.findings if f.alternatives]
    meant = true.union(*(family for family in TWINS if family & true))
    named_wrong = [f.name for f in found.findings if not f.open and f.name not in meant]
    scores: dict[str, Any] = {
        "verdict": found.verdict,
        "visible": [round(v, 3) for v in setting.visible],
        "found": [list(f.names) for f in found.findings],
        "where": [list(f.where) for f in found.findings],
        "parts": [[f"{p.part}: {p.name}" for p in f.partial_aliases] for f in found.findings],
        "covered": covered,
        "exact": covered and not sets and len(names) == len(true),
        "minimal": covered and len(names) == len(true) and _minimal(setting, sets, best),
        "extra": sum(not n & true for n in names),
        "wrong_name": named_wrong,
        "wrong_single": bool(named_wrong) and found.verdict == "named",
        "told_apart": best is not None
        and bool(named_wrong)
        and told_apart(setting, [t for f in found.findings for t in f.terms]),
        "located": _is_located(setting, found),
        "flag": found.structure.flag,
        "structure": {
            "p": found.structure.p_value,
            "inputs": list(found.structure.inputs),
            "size_mm": 1e3 * found.structure.size_m,
            "share": found.structure.share_explained,
        },
        "probabilities": [[f.name, f.probability, dict(f.chances)] for f in found.findings],
        "none_of_these": found.none_of_these,
        "causes": [[c.formula, c.probability] for c in found.causes],
        "written": found.written,
        "noise_mm": (1e3 * found.explained.noise.sigma).round(4).tolist(),
        "rho": found.explained.noise.rho,
        "intervals": _intervals(setting, found),
        "errors_mm": errors,
    }
    scores["dangerous"] = bool(
        found.verdict == "named"
        and named_wrong
        and np.hypot(errors["with_effects"], errors["floor"]) > 2 * errors["floor"]
    )
    return scores


def true_fit(setting: LoopSetting, session: Session | None = None) -> ModelFit:
    """Return the model that holds exactly the hidden effects, in their best form, fitted.

    Args:
        setting: the case with its hidden effects.
        session: rows; the training rows by default.

    Raises:
        InputError: an effect is in no library.
    """
    return _best(setting, [_forms(setting, name) for name in setting.case.effects], session)


def _best(
    setting: LoopSetting, menus: Sequence[list[tuple[Term, ...]]], session: Session | None = None
) -> ModelFit:
    """Return the likeliest of the combinations of one form per effect."""
    rows = setting.train if session is None else session
    made = (tuple(t for form in forms for t in form) for forms in itertools.product(*menus))
    return min((_fit_terms(setting, terms, rows, session is None) for terms in made), key=_misfit)


def _fit_terms(
    setting: LoopSetting, terms: Sequence[Term], rows: Session, robust: bool
) -> ModelFit:
    model = declared_model(setting.arm).plus(*geometry_terms(setting.arm, rows), *terms)
    return fit_model(model, rows, sigma=setting.sigma, robust=robust)


def _misfit(fitted: ModelFit) -> float:
    white = fitted.whiten_columns(fitted.residual[..., None])
    return float((white**2).sum() / 2) + 0.5 * 4.2**2 * float((fitted.weights == 0).sum())


def _forms(setting: LoopSetting, name: str) -> list[tuple[Term, ...]]:
    """Return each form of an effect at all of its places, and all compatible forms together."""
    known = list_candidates(setting.arm, setting.train.context(), (BUILT_IN[name],))
    most = max(len(c.terms) for c in known.testable)
    forms = [c.terms for c in known.testable if len(c.terms) == most]
    every = tuple(t for form in forms for t in form)
    together = len(forms) > 1 and len({t.place for t in every}) == len(every)
    return [*forms, every] if together else forms


def _errors(setting: LoopSetting, found: Diagnosis, best: ModelFit | None) -> dict[str, float]:
    """Compute RMS 3-D errors by the noise-free truth at fresh poses off the grid, and the noise."""
    models: dict[str, Model] = dict(found.models)
    if best is not None:
        models["true_effects"] = best.model
    errors = {
        name: _rms(setting.clean_held_out, model, setting.held_out)
        for name, model in models.items()
    }
    for name in ("with_effects", "true_effects"):
        if name in models:
            errors[f"{name}_train"] = _rms(setting.clean_train, models[name], setting.train)
    errors["floor"] = 1e3 * float(np.sqrt((setting.sigma**2).sum()))
    return errors


def _rms(clean: np.ndarray, model: Model, session: Session) -> float:
    error = clean - model.measured(session.q, session.context())
    return 1e3 * float(np.sqrt((error**2).sum(axis=1).mean()))


def _minimal(setting: LoopSetting, sets: Sequence[Finding], best: ModelFit | None) -> bool:
    """Return whether no member of a set can be told from the truth by these rows."""
    if not sets or best is None:
        return best is not None
    clean = _clean(setting)
    least = _misfit(true_fit(setting, clean))
    true = setting.case.effects
    for found in sets:
        own = next((t for t in true if t in found.names), None)
        if own is None:
            return False
        rest = [_forms(setting, t) for t in true if t != own]
        for name in found.names:
            if name != own and not any({name, own} <= family for family in TWINS):
                other = _best(setting, [*rest, _forms(setting, name)], clean)
                if _misfit(other) - least > ALIKE:
                    return False
    return True


def told_apart(setting: LoopSetting, terms: Sequence[Term]) -> bool:
    """Return whether the training rows, without noise, tell these effects from the hidden ones."""
    clean = _clean(setting)
    least = _misfit(true_fit(setting, clean))
    return _misfit(_fit_terms(setting, terms, clean, robust=False)) - least > ALIKE


def _clean(setting: LoopSetting) -> Session:
    """Return the training rows as they would be without noise and outliers."""
    return dataclasses.replace(setting.train, xyz=setting.clean_train, sigma=None)


def _is_located(setting: LoopSetting, found: Diagnosis) -> bool | None:
    """Return whether the strongest place of the finding that covers the effect is true."""
    if not setting.case.one_place:
        return None
    answers = []
    for effect in setting.effects:
        where = places(effect, setting.arm)
        mine = [f for f in found.findings if effect.name in f.names]
        if len(where) == 1 and mine:
            answers.append(bool(_stated_places(found, mine[0], effect.name) & where))
    return all(answers) if answers else None


def _stated_places(found: Diagnosis, finding: Finding, name: str) -> set[str]:
    """Return places of an effect in a finding: its strongest place, or those of the alternative."""
    if finding.name == name:
        return {_strongest(found, finding.terms)}
    return {w for a in finding.alternatives if a.candidate.name == name for w in a.candidate.where}


def _strongest(found: Diagnosis, terms: tuple[Effect | Bias, ...]) -> str:
    """Place with the largest shift of the tip."""
    fitted = found.explained.fit
    sizes: dict[str, float] = {}
    mine = {(t.name, t.where) for t in terms}
    shifts: dict[str, np.ndarray] = {}
    for k, slot in enumerate(fitted.slots):
        if (slot.owner.name, slot.owner.where) in mine:
            part = fitted.columns[..., k] * fitted.model.values[k]
            shifts[slot.owner.where] = shifts.get(slot.owner.where, 0.0) + part
    for where, shift in shifts.items():
        sizes[where] = float(((shift - shift.mean(axis=0)) ** 2).sum())
    return max(sizes, key=lambda w: sizes[w]) if sizes else terms[0].where


def _intervals(setting: LoopSetting, found: Diagnosis) -> list[dict[str, Any]]:
    """True value and 95 % interval of every found parameter that the simulator has too."""
    rows = []
    for effect in setting.effects:
        true = values(effect, setting.arm)
        if not any(f.name == effect.name for f in found.findings):
            continue
        for k, slot in enumerate(found.fit.slots):
            key = slot.owner.where, slot.parameter.name
            if slot.owner.name == effect.name and key in true:
                i = found.intervals[k]
                rows.append(
                    {
                        "of": f"{effect.name} {key[0]} {key[1]}",
                        "true": true[key],
                        "value": i.value,
                        "low": i.low,
                        "high": i.high,
                    }
                )
    return rows
