"""The proof: every row predicted by models that were fitted without it.

For each fold, the effects are chosen anew (`Resampling.explain_sample`) and fitted anew, on the
other rows.  The offers, their forms and the noise are those of all rows.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.calibration.calibrate import Errors
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.plausible import WORST
from longarm_comp.core.data.commanded import commanded_errors
from longarm_comp.core.data.measurement import compute_tip_errors, compute_turn_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.identify.gains import Gain
from longarm_comp.core.identify.posterior.found import FoundEffect
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model

CALIBRATED, WITH_EFFECTS, WITH_FUNCTIONS = "calibrated", "with_effects", "with_functions"
NETWORK = "with_network"
"""Name of the stage with a learned correction on top of the model."""


@dataclass(frozen=True)
class Fold:
    """A fold: models that were fitted without some rows, and these rows.

    Attributes:
        models: the models by name, plainer ones first.
        fits: the fits of the calibrated model and of fuller ones, by name.
        rows: the M held-out rows, in time order; each holds a measurement.
        numbers: (M,) their positions among the fitted rows, or among the rows given to hold out.
    """

    models: Mapping[str, Model]
    fits: Mapping[str, ModelFit]
    rows: Session
    numbers: np.ndarray


@dataclass(frozen=True)
class Proof:
    """Errors of every model at rows that it was fitted without.

    Attributes:
        errors: by model name, (M, 3) measured - predicted, m, at the rows that tell the tip's
            position (`core/data/measurement.py`).
        commanded: the same as a command would have them (`core/data/commanded.py`).
        turned: by model name, (K, 3) errors of the tip's orientation, rad, at rows that measure it.
        rows_at: (M,) positions of the rows of `errors` among all held-out rows. A touch is left out
            if no other row of its fold touches the same point.
        fold: (M,) number of the fold of each row of `errors`; all 0 if the rows to hold out were
            given.
        fold_of_turned: (K,) the same of each row of `turned`.
    """

    errors: Mapping[str, np.ndarray]
    commanded: Mapping[str, np.ndarray]
    turned: Mapping[str, np.ndarray]
    rows_at: np.ndarray
    fold: np.ndarray
    fold_of_turned: np.ndarray

    @property
    def rows(self) -> dict[str, Errors]:
        """Statistics of `errors` and `turned` by model name."""
        return {name: Errors.of(error, self.turned[name]) for name, error in self.errors.items()}

    @property
    def turn_sizes(self) -> dict[str, np.ndarray]:
        """Size (K,) of each error of the orientation, rad, by model name."""
        return {name: np.linalg.norm(error, axis=1) for name, error in self.turned.items()}

    def expected_errors(
        self, found: Sequence[FoundEffect], names: Sequence[str]
    ) -> dict[str, np.ndarray]:
        """Compute the (M,) error, m, that a command is expected to have at each row, by model.

        A bias moves the sighting, not the tip, so a command does not have the error that it
        explains. The mean of the squared errors as seen and as commanded is taken. The weight of
        the former is the probability that all biases found in the fullest model are really biases.
        """
        all_true = 1.0
        for f in found:
            if isinstance(f.terms[0], Bias):
                all_true *= f.presence * f.chance_bias
        made = {}
        for name in names:
            seen, commanded = ((e[name] ** 2).sum(1) for e in (self.errors, self.commanded))
            made[name] = np.sqrt(all_true * seen + (1.0 - all_true) * commanded)
        return made


def describe_worsening(
    before: np.ndarray, after: np.ndarray, fold: np.ndarray, unit: str = "mm"
) -> str:
    """Say how much errors rise if this is not by chance, on all rows or on the worst; else "".

    Args:
        before, after: (M,) m or rad, the errors of two models at the same rows. The worst rows are
            the share `WORST` of them, by the larger of both errors.
        fold: (M,) number of the fold of each row.
        unit: ``mm`` or ``mrad``.
    """
    longest = np.maximum(before, after)
    worst = np.sort(np.argsort(-longest, kind="stable")[: math.ceil(WORST * len(longest))])
    for rows, said in ((np.arange(len(longest)), "rows"), (worst, "worst rows")):
        gain = Gain.of_lengths(before[rows], after[rows], fold[rows])
        if gain.ci95[1] < 0.0:
            change = f"{1e3 * gain.before:.2f} -> {1e3 * gain.after:.2f} {unit}"
            return f"{change} at {len(rows)} {said}"
    return ""


def prove_models(
    folds: Sequence[Fold], train: Callable[[Fold], tuple[Model, Predictor]] | None = None
) -> Proof:
    """Compute the errors of every model at the rows that it was fitted without, in their order.

    Args:
        folds: the folds.
        train: returns for a fold a model and a predictor that was trained without its rows.
            Outside the predictor's domain the model alone predicts. None: no network is proved.
    """
    seen, commanded, turned = (defaultdict[str, list[np.ndarray]](list) for _ in range(3))
    for fold in folds:
        placed, turning = (fold.rows.take(m) for m in (fold.rows.placed, fold.rows.has_orientation))
        predictions = [(name, model, np.zeros(3)) for name, model in fold.models.items()]
        if train is not None:
            model, network = train(fold)
            expected = network.predict(placed.q, placed.context())
            known = (expected.in_domain & placed.has_position)[:, None]
            predictions.append((NETWORK, model, np.where(known, expected.error, 0.0)))
        for name, model, error in predictions:
            missed = compute_tip_errors(model, placed)
            seen[name].append(missed - error)
            commanded[name].append(commanded_errors(model, placed, seen=missed) - error)
            turned[name].append(compute_turn_errors(model, turning))
    held = np.sort(np.concatenate([f.numbers for f in folds]))
    (rows_at, of_fold), (turned_at, of_turned) = (
        (np.concatenate(each), np.repeat(np.arange(len(folds)), [*map(len, each)]))
        for each in (
            [f.numbers[f.rows.placed] for f in folds],
            [f.numbers[f.rows.has_orientation] for f in folds],
        )
    )
    order, turns = np.argsort(rows_at), np.argsort(turned_at)
    at_seen, at_commanded, at_turned = (
        {name: np.concatenate(parts)[rows] for name, parts in by_fold.items()}
        for by_fold, rows in ((seen, order), (commanded, order), (turned, turns))
    )
    places = np.searchsorted(held, rows_at[order]), of_fold[order], of_turned[turns]
    return Proof(at_seen, at_commanded, at_turned, *places)
