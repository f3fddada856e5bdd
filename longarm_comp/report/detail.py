"""The data of the page that report.json does not hold, in m and rad; error = measured - predicted.

All parts are optional: a verdict of noise has no guilty input, one of bad_data no rows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from longarm_comp.core.calibration.candidates import Term
from longarm_comp.core.effects.effect import Bias
from longarm_comp.core.effects.units import in_names
from longarm_comp.core.identify.candidate_states import best_forms
from longarm_comp.core.identify.diagnosis import SPLITS, Diagnosis
from longarm_comp.core.model.encoders import tell_apart
from longarm_comp.core.model.link_frames import outline
from longarm_comp.core.model.model import unstack
from longarm_comp.core.model.tip_motion import stack
from longarm_comp.core.planning.splitting_poses import SplittingPoses

_UNITS = {"temperature_c": "°C", "payload_kg": "kg", "t_s": "s"}
Line = tuple[str | float | None, ...]


class PageTable(NamedTuple):
    """A table of the page: its cells are text, numbers, or None for a dash."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[Line, ...]


class Input(NamedTuple):
    """One input of the rows, as report.json calls it (``q2``, ``approach``); `values` (N,)."""

    name: str
    unit: str
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class SeenRows:
    """The held-out rows of a session whose marker was seen.

    Attributes:
        index: (N,) row numbers in the session.
        measured_m: (N, 3) measured tip.
        errors_m: (N, 3) measured - predicted by stage (`style.LOOKS`).
        inputs: the inputs that errors are plotted over, joints first.
        arms_m: centre-lines (K, 3), base to tip, at a few of these rows.
    """

    index: np.ndarray
    measured_m: np.ndarray
    errors_m: Mapping[str, np.ndarray]
    inputs: tuple[Input, ...] = ()
    arms_m: tuple[np.ndarray, ...] = ()


class SetSplit(NamedTuple):
    """Effects that these data cannot distinguish, and the number of further poses that would.

    `reason` says why no poses would. `expected_log_bayes_factor` is the one between the two closest
    members once the poses are measured.
    """

    members: tuple[str, ...]
    expected_log_bayes_factor: float
    poses: int = 0
    reason: str = ""


class Marked(NamedTuple):
    """The centre-line (K, 3) of the arm in one posture, and the points (3,) of a finding."""

    arm_m: np.ndarray
    places_m: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Detail:
    """Everything on the page that report.json does not hold.

    Attributes:
        held_out: the held-out rows.
        guilty: inputs that the findings, or the structure left, depend on; the worst first.
        correlation: the geometry that each parameter of a finding is most correlated with.
        detectable: the smallest size of each effect that these data would have shown, and its RMS
            at the tip (mm); None where no size would show, as the data do not excite it.
        splits: the sets, and whether further poses would tell their members apart.
        encoders: reading - command of the joints over the fitted rows.
        marked: where each finding is on the arm, in the order of the cards.
        provenance: further facts, shown after those of report.json.
    """

    title: str = "Diagnosis"
    held_out: SeenRows | None = None
    guilty: tuple[str, ...] = ()
    correlation: PageTable | None = None
    detectable: PageTable | None = None
    splits: tuple[SetSplit, ...] = ()
    encoders: PageTable | None = None
    marked: tuple[Marked, ...] = ()
    provenance: Mapping[str, str] = field(default_factory=dict)


def detail(diagnosis: Diagnosis, facts: Mapping[str, str]) -> Detail:
    """Return what report.html shows and report.json does not hold.

    Args:
        facts: further facts for its provenance, by name.
    """
    arm = diagnosis.arm
    units = tuple("m" if slides else "rad" for slides in arm.slides)
    rows = _collect_rows(diagnosis, units)
    return Detail(
        title=f"{diagnosis.arm.name}: {facts.get('session', 'session')}",
        held_out=rows,
        guilty=_find_guilty(diagnosis, rows),
        correlation=_list_correlations(diagnosis),
        detectable=_list_detectable(diagnosis),
        splits=tuple(_describe_split(diagnosis, s) for s in diagnosis.split_by),
        encoders=_compare_encoders(diagnosis, units),
        marked=_mark_places(diagnosis),
        provenance=facts,
    )


def _collect_rows(diagnosis: Diagnosis, units: Sequence[str]) -> SeenRows:
    held = diagnosis.held_out.take(diagnosis.proof.rows_at)
    predicted = diagnosis.model.measured(held.q, held.context())
    near = predicted + diagnosis.proof.errors[diagnosis.written]
    seen = np.where(held.has_position[:, None], held.xyz, near)
    # Up to six arms are drawn in the scene
    shown = np.unique(np.linspace(0, len(held) - 1, min(6, len(held))).astype(int))
    context, model = held.context(), diagnosis.model
    arms = tuple(outline(model, held.q[k], context.take(int(k))) for k in shown)
    # Joints, mean approach side, and every recorded column that varies
    inputs = [Input(f"q{j + 1}", unit, held.q[:, j]) for j, unit in enumerate(units)]
    if held.approach.any():
        inputs.append(Input("approach", "", held.approach.mean(axis=1)))
    varying = [(name, values) for name, values in context.columns.items() if np.ptp(values) > 0]
    inputs += [Input(name, _UNITS.get(name, ""), values) for name, values in varying]
    return SeenRows(held.index, seen, diagnosis.proof.errors, tuple(inputs), arms)


def _find_guilty(diagnosis: Diagnosis, rows: SeenRows) -> tuple[str, ...]:
    """Return up to four inputs: those of the findings, then those of the structure that is left."""
    commanded = list(diagnosis.arm.commanded)
    names: list[str] = []

    def size(term: Term) -> float:
        """Return the largest parameter of a term, in prior standard deviations."""
        own = term.parameters(diagnosis.arm)
        return max((abs(getattr(term, p.name)) / p.prior for p in own if p.prior > 0), default=0)

    for found in diagnosis.findings:
        largest = sorted(found.terms, key=lambda term: -size(term))
        for term in largest[:2]:
            names += [f"q{commanded.index(j) + 1}" for j in term.joints if j in commanded]
        names += found.terms[0].inputs
    names += diagnosis.structure.inputs
    known = {entry.name for entry in rows.inputs}
    # The residual is plotted against four inputs at most
    return tuple(name for name in dict.fromkeys(names) if name in known)[:4]


def _list_correlations(diagnosis: Diagnosis) -> PageTable | None:
    """Return, for each parameter of a finding, its five strongest correlations with geometry."""
    found = {t.key for f in diagnosis.findings for t in f.terms}
    fit, called = diagnosis.fit, diagnosis.arm.names_for_people
    own = [k for k, s in enumerate(fit.slots) if s.owner.key in found]
    rest = np.array([k for k, s in enumerate(fit.slots) if s.owner.geometry], dtype=int)
    if not own or not len(rest):
        return None
    labels = [
        in_names(f"{s.owner.name} {s.owner.where} {s.parameter.name}", called) for s in fit.slots
    ]
    rows = []
    for k in own:
        r = fit.covariance[k, rest] / (fit.standard_errors[k] * fit.standard_errors[rest])
        first = np.argsort(-np.abs(r), kind="stable")[:5]
        named = (f"{labels[rest[j]]} ({r[j]:+.2f})".replace("-", "−") for j in first)
        rows.append((labels[k], ", ".join(named)))
    caption = "Strongest correlations of every parameter"
    return PageTable(caption, ("Parameter", "Geometry (correlation)"), tuple(rows))


def _list_detectable(diagnosis: Diagnosis) -> PageTable:
    """Return the smallest size that would show, by effect and place, of effects with one term."""
    rows: list[Line] = []
    for (name, place), one in sorted(best_forms(diagnosis.smallest).items()):
        slots = one.candidate.slots(diagnosis.arm)
        if len(one.candidate.terms) > 1 or not slots:
            continue
        p, where = slots[0].parameter, in_names(place, diagnosis.arm.names_for_people)
        size = (one.size * p.prior, p.unit, 1e3 * one.shift_m)
        unseen = (None, "not excited by these data", None)
        rows.append((name, where, p.name, *(size if np.isfinite(one.size) else unseen)))
    caption = "A smaller effect may exist; these data cannot show it."
    head = ("Effect", "Where", "Parameter", "Size", "Unit", "At the tip, mm RMS")
    return PageTable(caption, head, tuple(rows))


def _describe_split(diagnosis: Diagnosis, by: SplittingPoses) -> SetSplit:
    """Return how many poses would tell the names of a set apart, or why none would."""
    found = next(f for f in diagnosis.findings if f.name == by.between[0])
    if by.log_bayes_factor >= SPLITS:
        return SetSplit(found.names, by.log_bayes_factor, len(by.q))
    pair = f"{by.between[0]} and {by.between[1]}"
    reason = f"No pose tells {pair} apart: expected log odds {by.log_bayes_factor:.1f}."
    others, read = found.alternatives[0].candidate.terms, diagnosis.fit.session.read_joints
    at_places = [(mine, o) for mine in found.terms for o in others if o.where == mine.where]
    deciding = [
        f"read_q{k + 1}"
        for k, row in enumerate(diagnosis.arm.commanded)
        if k not in read and any(tell_apart(diagnosis.arm, [row], *pair) for pair in at_places)
    ]
    if deciding:
        reason += f" What the encoders say does ({', '.join(deciding)})."
    if any({"temperature_c", "t_s"} & set(t.needs) for t in (*found.terms, *others)):
        reason += " Measure again after a pause, at another temperature."
    return SetSplit(found.names, by.log_bayes_factor, reason=reason)


def _compare_encoders(diagnosis: Diagnosis, units: Sequence[str]) -> PageTable | None:
    """Return a comparison of encoder readings with commands; None if no joint is read."""
    fit = diagnosis.fit
    rows, names = fit.session, diagnosis.arm.joint_names
    lines: list[Line] = []
    for k in rows.read_joints:
        name = f"read_q{k + 1}"
        channel = rows.channels.index(name)
        held = rows.measured[:, channel] & (fit.weights > 0)
        off = 1e3 * (rows.readings[name][held, 0] - rows.q[held, k])
        about = off - off.mean()
        left = 1e3 * np.sqrt(np.mean(fit.residual[held, channel] ** 2))
        noise = 1e3 * fit.sigma[channel]
        figures = (off.mean(), about.std(), np.abs(about).max(), left, noise)
        lines.append((names[k], *map(float, figures), f"m{units[k]}"))
    if not lines:
        return None
    caption = (
        "Reading − command, over the fitted rows. Effects before an encoder show here; effects "
        "behind it do not."
    )
    head = ("Joint", "mean", "spread, RMS", "largest from mean", "left by the model, RMS", "noise")
    return PageTable(caption, (*head, "Unit"), tuple(lines))


def _mark_places(diagnosis: Diagnosis) -> tuple[Marked, ...]:
    """Return where findings and causes are on the arm, at the row farthest from the mean."""
    found = [f.terms for f in diagnosis.findings] + [c.effects for c in diagnosis.causes]
    if not found:
        return ()
    rows, model = diagnosis.held_out, diagnosis.model
    tips = model.tip(rows.q, rows.context())
    row = int(np.linalg.norm(tips - tips.mean(axis=0), axis=1).argmax())
    context, q = rows.context().take(row), rows.q[row]
    line, posture = outline(model, q, context), model.posture(unstack(q), context)
    camera, called, marked = model.arm.camera, model.arm.names_for_people, []
    for terms in found:
        points: dict[str, list[np.ndarray]] = {}
        for term in terms:
            # The stations that it turns or moves; of a camera, the camera; else the tip
            if isinstance(term, Bias):
                at = [] if camera is None else [np.array(camera.position_m, dtype=float)]
            else:
                stations = [posture.bearing(joint) for joint in term.joints]
                stations = stations or [k for k in term.twists(posture) if k >= 0]
                at = [stack(posture.frames[k].p) for k in stations]
            own = points.setdefault(called.get(term.where, term.where), [])
            own += at or [stack(model.tip_frame(posture).p)]
        marked.append(Marked(line, {name: np.mean(held, axis=0) for name, held in points.items()}))
    return tuple(marked)
