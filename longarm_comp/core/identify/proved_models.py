"""The models that a diagnosis may write: fits them, proves them on held-out rows, chooses one."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.kind_of_arm import fold_directions
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.placed_model import place_as_seen
from longarm_comp.core.data.holdout import folds_of
from longarm_comp.core.data.session import Session
from longarm_comp.core.identify.posterior.explained import NEAR, ExplainedSession
from longarm_comp.core.identify.posterior.found import CREDIBLE, FoundEffect, keys_of
from longarm_comp.core.identify.proof import (
    CALIBRATED,
    NETWORK,
    WITH_EFFECTS,
    WITH_FUNCTIONS,
    Fold,
    Proof,
    describe_worsening,
    prove_models,
)
from longarm_comp.core.learn.predictor import Predictor
from longarm_comp.core.model.model import Model

Train = Callable[[Model, Session], Predictor]


@dataclass(frozen=True)
class ProvedModels:
    """Models that may be written, with the proof of each and the choice among them.

    Attributes:
        explained: the explained session with the effects that were found.
        fits: fits of the models calibrated, with_effects and (if there are functions)
            with_functions, by name, to the same rows with the same noise.
        models: nominal, frames_only and the models of `fits`, as files hold them.
        held_out: the rows of the proof.
        folds: the same models fitted without some rows; every held-out row is in one fold.
        proof: their errors at these rows, and those with a network if there is one.
        expected: by name of the fits that differ, the mean error, m, that a command is expected to
            have; empty if no held-out row tells the tip's position.
        written: name of the model to write.
        failed: how a fuller model failed its proof; empty if none did.
    """

    explained: ExplainedSession
    fits: Mapping[str, ModelFit]
    models: Mapping[str, Model]
    held_out: Session
    folds: tuple[Fold, ...]
    proof: Proof
    expected: Mapping[str, float]
    written: str
    failed: str

    @property
    def fullest(self) -> list[tuple[ModelFit, Session]]:
        """The fit of the fullest model in each fold, and the rows of this fold."""
        return [(list(f.fits.values())[-1], f.rows) for f in self.folds]

    def train_network(self, train: Train) -> tuple[Predictor | None, Proof]:
        """Train a network on the residual of the model to write, and prove it.

        If every row is held out once, one more network is trained for each fold, without its rows.

        Args:
            train: trains a predictor for a model on the rows to which it was fitted.

        Returns:
            The network, None if it does not help or `choose_written` prefers the model alone; and
            the proof, with the network's errors if there is a network.
        """
        final = self.fits[self.written]
        network = train(final.model, final.session.take(final.weights > 0))
        if not network.gain.helps:
            return None, self.proof

        def train_on_fold(fold: Fold) -> tuple[Model, Predictor]:
            if len(self.folds) == 1:
                return final.model, network
            kept = fold.fits[self.written]
            return kept.model, train(kept.model, kept.session.take(kept.weights > 0))

        proof = prove_models(self.folds, train_on_fold)
        names = (self.written, NETWORK)
        seen = {name: np.linalg.norm(proof.errors[name], axis=1) for name in names}
        expected = proof.expected_errors(self.explained.found, names)
        written, _ = choose_written(expected, seen, proof.fold)
        return (network, proof) if written == NETWORK else (None, self.proof)


def prove_written(
    nominal: Model,
    staged: Mapping[str, ModelFit],
    explained: ExplainedSession,
    test: Session | None,
    seed: int,
) -> ProvedModels:
    """Fit the models that may become the model file, test them on held-out rows, and choose one.

    Args:
        nominal: the model before.
        staged: fits of its placements (``frames_only``) and of its geometry (``geometry``).
        explained: the explained session with the effects that were found.
        test: the held-out rows; None: every fitted row is held out once, in folds.
        seed: seed of the folds.

    Raises:
        JobError: a fit to a part of the rows diverged.
    """
    fits = _fit_written_models(staged["geometry"].model, explained)
    frames_only = staged["frames_only"].model
    folded = {name: fold_directions(fitted) for name, fitted in fits.items()}
    models = {
        "nominal": place_as_seen(nominal, explained.fit.session)[0],
        "frames_only": frames_only,
        **{name: fitted.model for name, fitted in folded.items()},
    }
    if test is None:
        held_out, folds = _fit_folds(nominal, frames_only, fits, explained, seed)
    else:
        held_out = test.take(test.seen)
        folds = (Fold(models, fits, held_out, np.arange(len(held_out))),)
    proof = prove_models(folds)
    bare = fits[CALIBRATED]  # the same fit is no second model, whatever the folds added
    offered = [name for name in fits if name == CALIBRATED or fits[name] is not bare]
    expected = proof.expected_errors(explained.found, offered)
    seen = {name: np.linalg.norm(each, axis=1) for name, each in proof.errors.items()}
    if len(proof.rows_at):
        choice = choose_written(expected, seen, proof.fold)
    else:  # only orientations were measured
        turns = {name: proof.turn_sizes[name] for name in offered}
        choice = choose_written(turns, turns, proof.fold_of_turned, "mrad")
    means = {name: float(each.mean()) for name, each in expected.items() if len(each)}
    return ProvedModels(explained, folded, models, held_out, folds, proof, means, *choice)


def choose_written(
    expected: Mapping[str, np.ndarray],
    seen: Mapping[str, np.ndarray],
    fold: np.ndarray,
    unit: str = "mm",
) -> tuple[str, str]:
    """Choose the model to write, and say how the proofs of fuller models failed.

    A model is excluded if commands are expected to err more with it than with a plainer one, not by
    chance (`describe_worsening`). Its proof fails if its errors as seen are larger than a plainer
    one's, not by chance. Of the other models that with the least expected mean error is chosen, of
    equals the plainer one.

    Args:
        expected: by model, plainer ones first: the (M,) expected errors of commands, m or rad.
        seen: by model: the (M,) errors as seen, m or rad.
        fold: (M,) number of the fold of each row.
        unit: ``mm``, or ``mrad`` of errors in rad.

    Returns:
        The name of the chosen model, and the failed proofs in words.
    """
    written, failed = dict(expected), dict[str, str]()
    for name, plainer in combinations(list(expected)[::-1], 2):
        if describe_worsening(expected[plainer], expected[name], fold):
            written.pop(name, None)
        if rise := describe_worsening(seen[plainer], seen[name], fold, unit):
            failed[name] = f"{plainer} -> {name}: {rise}"
    left = {name: each.mean() for name, each in written.items() if name not in failed}
    return min(left, key=left.__getitem__), "; ".join(failed.values())


def _fit_written_models(start: Model, found: ExplainedSession) -> dict[str, ModelFit]:
    """Fit the calibrated model, that with effects and that with functions, to the same rows."""
    whole = found.fit
    bare = fit_model(start, whole.session, **whole.noise_arguments)
    functions = keys_of(f for f in found.found if f.unnamed)
    if functions:
        less = fit_model(whole.model.without(functions), whole.session, **whole.noise_arguments)
        return {CALIBRATED: bare, WITH_EFFECTS: less, WITH_FUNCTIONS: whole}
    more = found.found or found.tolerance.compliance
    return {CALIBRATED: bare, WITH_EFFECTS: whole if more else bare}


def _fit_folds(
    nominal: Model,
    frames_only: Model,
    fits: Mapping[str, ModelFit],
    explained: ExplainedSession,
    seed: int,
) -> tuple[Session, tuple[Fold, ...]]:
    """Fit everything anew without each fold of the rows.

    Returns the rows that are held out once, and the folds.

    Raises:
        JobError: a fit without some rows did not stay finite.
    """
    session = explained.fit.session
    fold = folds_of(session, seed)
    made = []
    for number in range(int(fold.max()) + 1):
        kept = fold != number
        rows = session.take(kept)
        models = {
            "nominal": place_as_seen(nominal, rows)[0],
            "frames_only": fit_model(frames_only, rows, close=NEAR).model,
        }
        refitted = _refit_fold(fits, explained, kept)
        models |= {name: fitted.model for name, fitted in refitted.items()}
        made.append(Fold(models, refitted, session.take(~kept), np.flatnonzero(~kept)))
    return session.take(fold >= 0), tuple(made)


def _refit_fold(
    fits: Mapping[str, ModelFit], explained: ExplainedSession, kept: np.ndarray
) -> dict[str, ModelFit]:
    """Fit the models with the effects that a part of the rows alone would find, to this part."""
    whole, session = explained.fit, explained.fit.session.take(kept)
    judged = {"sigma": whole.sigma, "rho": whole.rho, "weights": whole.weights[kept]}

    def refit(model: Model) -> ModelFit:
        return fit_model(model, session, close=NEAR, **judged)

    made = {CALIBRATED: refit(fits[CALIBRATED].model)}
    found = (
        explained.resampling.explain_sample(kept.astype(float))
        if explained.resampling is not None
        else ()
    )
    sure = [f for f in found if f.presence >= CREDIBLE]
    named = refit(_replace_found(explained, [f for f in sure if not f.unnamed]))
    made[WITH_EFFECTS] = named
    if WITH_FUNCTIONS in fits:
        more = any(f.unnamed for f in sure)
        made[WITH_FUNCTIONS] = refit(_replace_found(explained, sure)) if more else named
    return made


def _replace_found(explained: ExplainedSession, found: Sequence[FoundEffect]) -> Model:
    """Return the model of an explained session with the effects `found` instead of its own."""
    model = explained.fit.model
    known = {t.variant: t for t in model.terms}
    terms = {t.key: known.get(t.variant, t) for f in found for t in f.terms}
    gone = keys_of(explained.found)
    other = model.without(gone | set(terms)).plus(*terms.values())
    small = {s.identity for s in other.slots if s.owner.key in terms}
    beyond = tuple(b for b in model.beyond if b[0] not in small)
    return dataclasses.replace(other, beyond=beyond)
