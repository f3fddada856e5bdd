"""Calibration: geometry and declared effects fitted to a session, judged on held-out blocks."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration import plausible
from longarm_comp.core.calibration.calibrate import Rung, fit_ladder, fit_stages
from longarm_comp.core.calibration.candidates import Term
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.kind_of_arm import KindOfArm, fold_directions
from longarm_comp.core.calibration.linear import SIZES
from longarm_comp.core.calibration.model_fit import ModelFit
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.calibration.undetermined import Place, list_places, list_undetermined
from longarm_comp.core.data.holdout import blocked_split
from longarm_comp.core.data.kinds import KINDS
from longarm_comp.core.data.measurement import compute_tip_errors, compute_turn_errors
from longarm_comp.core.data.session import Session
from longarm_comp.core.data.set_aside import SetAside
from longarm_comp.core.effects.catalogue import effect_class
from longarm_comp.core.effects.placements import BasePose
from longarm_comp.core.effects.units import for_people
from longarm_comp.core.errors import InputError
from longarm_comp.core.html_table import html_table
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import read_stored, restore, save_model, store
from longarm_comp.version import __version__
from longarm_comp.workflows import inputs
from longarm_comp.workflows.evaluate import ErrorTable


def kind_from(arm: Arm, given: Sequence[inputs.ModelLike]) -> tuple[KindOfArm, str]:
    """Return a prior for an arm from models of other arms of its kind, and these models' names."""
    models, names, origins = [], [], []
    noise: dict[str, list[float]] = {}
    for number, each in enumerate(given, 1):
        if isinstance(each, Model):
            models.append(each.lasting())
            names.append(f"model {number}")
            origins.append(names[-1])
            continue
        path, beside = Path(each), Path(each).parent / "arm.yaml"
        stored = read_stored(path)
        models.append(restore(stored, Arm.load(beside) if beside.is_file() else arm, str(path)))
        names.append(str(path))
        origins.append(f"{path.name} {inputs.file_hash(path)[:12]}")
        for kind in KINDS:
            sigma = stored.provenance.get(f"noise_{kind}")  # m or rad
            if isinstance(sigma, float) and sigma > 0:
                noise.setdefault(kind, []).append(sigma)
    usual = {kind: float(np.median(held)) for kind, held in noise.items()}
    return KindOfArm.of(arm, models, names, usual), ", ".join(origins)


@dataclass(frozen=True)
class _FittedParameter:
    """One fitted parameter with its 95 % interval, both in `unit`."""

    effect: str
    where: str
    name: str
    value: float
    unit: str
    ci95: tuple[float, float]
    geometry: bool  # whether the effect belongs to the geometry


@dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """A calibrated model, and the errors of each model of the ladder.

    Attributes:
        rungs: models of growing complexity, fitted without the held-out rows; the last
            `effect_rungs` add an effect each.
        held_out_rows: number of held-out rows, including those without a marker.
        fit: fit of the last rung to all rows.
        set_aside: rows that this fit set aside as outliers, and the traits that they share.
        kind_of: names and hashes of the models of other arms that gave the prior; empty if none.
    """

    rungs: tuple[Rung, ...]
    effect_rungs: int
    held_out_rows: int
    fit: ModelFit
    session: Session
    seed: int
    set_aside: SetAside
    kind_of: str = ""

    @cached_property
    def model(self) -> Model:
        """The calibrated model, with its uncertainty."""
        return with_uncertainty(self.fit)

    @property
    def held_out(self) -> ErrorTable:
        """Errors of every rung on the held-out rows."""
        return ErrorTable(
            {rung.name: rung.held_out for rung in self.rungs},
            {rung.name: rung.commanded for rung in self.rungs},
            {rung.name: len(rung.fit.outliers) if rung.fit else 0 for rung in self.rungs},
        )

    @property
    def placed(self) -> bool:
        """True if the nominal arm was placed by the rows, because they show it elsewhere."""
        return any(isinstance(e, BasePose) for e in self.rungs[0].model.effects)

    @property
    def untold(self) -> tuple[str, ...]:
        """The parts of the placements and of the arm's size that the rows do not determine.

        They stay at the values from which the fit began.
        """
        return list_undetermined(self.fit)

    @property
    def far_off(self) -> tuple[str, ...]:
        """Parameters, in words, that lie so far from arm.yaml that the file may be wrong there."""
        said, factors = [], dict(self.fit.model.beyond)
        for slot in self.fit.slots:
            if factors.get(slot.identity) == SIZES[-1]:
                times, unit = for_people(slot.parameter.unit)
                value, usual = (times * v for v in (slot.value, slot.parameter.width / SIZES[-1]))
                said.append(f"{slot.label}: {value:.3g} {unit} from arm.yaml (usual {usual:.2g})")
        return tuple(said)

    @property
    def places(self) -> tuple[Place, ...]:
        """The places of base and sensors as fitted to the rows, with their uncertainty."""
        return list_places(self.fit)

    @property
    def not_helping(self) -> tuple[str, ...]:
        """Effects that did not lower the held-out RMS error and are better left out."""
        last = self.rungs[-1 - self.effect_rungs :]
        return tuple(b.name for a, b in pairwise(last) if b.held_out.rms >= a.held_out.rms)

    @property
    def parameters(self) -> tuple[_FittedParameter, ...]:
        """Every fitted parameter with its interval."""
        fitted, made = self.fit, []
        rows = zip(fitted.slots, fitted.model.values, fitted.standard_errors, strict=True)
        for slot, value, se in rows:
            of, p, ci95 = slot.owner, slot.parameter, (value - 1.96 * se, value + 1.96 * se)
            made.append(
                _FittedParameter(of.name, of.where, p.name, value, p.unit, ci95, of.geometry)
            )
        return tuple(made)

    @property
    def summary(self) -> str:
        """The result of the calibration in one sentence."""
        first, last = self.rungs[0], self.rungs[-1]
        before, after = (r.commanded if r.commanded.n else r.held_out for r in (first, last))
        return (
            f"held-out mean error as commanded {before.mean_text} ({first.name}) -> "
            f"{after.mean_text} ({last.name}), "
            f"{len(self.fit.slots)} parameters fitted to {len(self.fit.session)} rows"
        )

    def _repr_html_(self) -> str:
        return html_table(self.summary, self.held_out.rows)

    def __repr__(self) -> str:
        return f"Calibration({self.summary})"

    def save(self, path: inputs.FilePath) -> Path:
        """Write model.yaml with 95 % intervals. An existing file becomes the previous version."""
        provenance: dict[str, str | int | float] = {
            "session_hash": self.session.hash,
            "session": self.session.source,
            "rows": len(self.fit.session),
            "seed": self.seed,
            "longarm_comp": __version__,
        }
        provenance |= {"kind_of": self.kind_of} if self.kind_of else {}
        # Noise by kind of measurement, m or rad: the root mean square over its channels
        squares: dict[str, list[float]] = {}
        kinds = [b.kind for b in self.session.blocks for _ in b.channels]
        for kind, sigma in zip(kinds, self.fit.sigma, strict=True):
            if np.isfinite(sigma):
                squares.setdefault(kind, []).append(float(sigma) ** 2)
        provenance |= {f"noise_{k}": float(np.sqrt(np.mean(v))) for k, v in squares.items()}
        save_model(path, store(self.model, self.fit.standard_errors, provenance=provenance))
        return Path(path)


def calibrate(
    arm: Arm,
    session: inputs.SessionLike,
    *,
    effects: Sequence[str | Term | Sequence[Term]] = (),
    deflection: bool = True,
    fraction: float = 0.2,
    seed: int = 0,
    kind_of: Sequence[inputs.ModelLike] = (),
    note: inputs.Note = inputs.log_note,
    progress: inputs.Telling = False,
) -> Calibration:
    """Fit geometry and declared effects of an arm to a session.

    Models of growing complexity are fitted without the held-out rows and compared on these. The
    last model is then fitted to all rows.

    Args:
        session: measurements, or their CSV or bag. Rows without a marker are not fitted.
        effects: effects to add, one model for each: a canonical name (at every joint or beam that
            may have it), one instance, or several that are fitted together.
        deflection: whether the declared beams sag.
        fraction: share of the rows to hold out.
        kind_of: calibrated models of other arms of the kind, or their files. This arm is then
            expected to differ from its drawing as they do. An arm.yaml beside a file declares the
            other arm; without one, the other arm is declared as this arm.
        note: called with each finding of the admission.
        progress: True: print each step; or a function, called with the step and the share done.

    Raises:
        InputError: the session was refused; an effect has no place on this arm or needs an input
            that was not recorded.
        JobError: a fit diverged, or may not be believed (`plausible.refuse_implausible`).
    """
    whole = inputs.admit_session(session, arm, note=note)
    chosen = [_terms_of(effect, arm, whole, note) for effect in effects]
    kind, origin = kind_from(arm, kind_of) if kind_of else (None, "")
    train, held_out = blocked_split(whole, fraction, rng=seed)
    steps, tell = 5 + len(chosen), inputs.make_teller(progress)
    done = iter(range(steps))
    rungs = fit_ladder(
        arm,
        train,
        held_out,
        chosen,
        deflection=deflection,
        kind=kind,
        progress=lambda name: tell(name, next(done) / steps),
    )
    last = rungs[-1].model
    size, unit = (
        (compute_tip_errors, "mm") if held_out.placed.any() else (compute_turn_errors, "mrad")
    )
    tell("all rows", (steps - 1) / steps)
    if kind is None:
        final = fit_model(last, whole)
    else:
        *_, (_, final) = fit_stages(declared_model(arm, deflection=deflection), whole, kind=kind)
        if chosen:
            terms = [term for _, each in chosen for term in each]
            final = fit_model(final.model.plus(*terms), whole, usual=kind.noise)
        final = fold_directions(final)
    left_out = held_out.take(plausible.mark_believed_rows(final, held_out))
    plainer = {"placed frames alone": rungs[1].model, "the declared arm": rungs[0].model}
    aside = plausible.refuse_implausible(
        final,
        size(last, train.take(plausible.mark_believed_rows(final, train))),
        size(last, left_out),
        {than: size(model, left_out) for than, model in plainer.items()},
        unit,
    )
    made = tuple(rungs), len(chosen), len(held_out)
    return Calibration(*made, final, whole, seed, aside, origin)


def _usable_places(
    terms: tuple[Term, ...], session: Session, note: inputs.Note
) -> tuple[Term, ...]:
    """Return the places of an effect whose inputs were recorded and change during the session.

    Raises:
        InputError: there is none, or a sensor of the effect has no row in arm.yaml.
    """
    context = session.context()
    usable, why = [], None
    for term in terms:
        try:
            term.require(context)
        except InputError as error:
            why = error
            continue
        read = [session.columns[name] for name in term.inputs if name in session.columns]
        # An input that changes by less, in its unit, says nothing
        if read and all(np.ptp(values) < 1e-5 for values in read):
            left = f"{term.name} at {term.where} left out: {term.inputs[0]} is idle"
            note(f"{session.source}: {left}")
            continue
        usable.append(term)
    if not usable:
        name = terms[0].name
        allowed = "an input that was recorded and changes"
        raise why or InputError(session.source, name, "idle everywhere", allowed)
    for term in usable:
        if sum(other.where == term.where for other in usable) > 1 and "sensor" in term.places:
            allowed = "its row in arm.yaml (longarm diagnose searches for it)"
            raise InputError("calibrate", term.where, "no row", allowed)
    return tuple(usable)


def _terms_of(
    given: str | Term | Sequence[Term], arm: Arm, session: Session, note: inputs.Note
) -> tuple[str, tuple[Term, ...]]:
    if isinstance(given, str):
        places: tuple[Term, ...] = effect_class(given, "calibrate").for_arm(arm)
        if not places:
            allowed = "an effect this arm can have"
            raise InputError("calibrate", given, "no place on this arm", allowed)
        return given, _usable_places(places, session, note)
    terms = (given,) if isinstance(given, Term) else tuple(given)
    if not terms:
        raise InputError("calibrate", "effects", "nothing", "a name or instances of an effect")
    return terms[0].name, terms
