"""95 % intervals: as wide as the truth asks, within the bounds, of what was found."""

import dataclasses

import numpy as np
import pytest
from discover_rows import DEMO
from hidden_arm import SIGMA, at, session
from rows_with_play import session_of
from small_arm import ARM

from longarm_comp.core.calibration.calibrate import declared_model, geometry_terms
from longarm_comp.core.calibration.candidates import Candidate
from longarm_comp.core.calibration.fit import fit_model
from longarm_comp.core.calibration.fit_columns import FitColumns
from longarm_comp.core.calibration.model_fit import ModelFit, prior_widths
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.drive_errors import JointGain
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.plays import Backlash
from longarm_comp.core.identify.intervals import Interval, _change_of_scales, compute_intervals
from longarm_comp.core.model.model import Model
from longarm_comp.sim.hidden import drives
from longarm_comp.sim.hidden.base import HiddenEffect


def fitted(rows: Session, *terms: JointGain | JointCompliance | Backlash) -> ModelFit:
    base = declared_model(ARM).plus(*geometry_terms(ARM, rows))
    return fit_model(base.plus(*terms), rows, sigma=np.full(3, SIGMA))


def of(
    rows: ModelFit, kind: type, found: bool = True, library_: tuple[Candidate, ...] = ()
) -> Interval:
    """The interval of the first parameter of one kind of effect."""
    slot = next(k for k, s in enumerate(rows.slots) if isinstance(s.owner, kind))
    mine = [t for t in rows.model.terms if isinstance(t, kind)] if found else []
    return compute_intervals(rows, mine, library_)[slot]


def gain(size: float, n: int = 120, seed: int = 1) -> Session:
    hidden: list[HiddenEffect] = [drives.JointGain(at(2, size))]
    return session(hidden, n=n, seed=seed)


def test_of_many_sessions_nineteen_in_twenty_hold_the_truth() -> None:
    """Of 40 sessions at least 34, and not with room to spare: binomial, 1 in 100 either way."""
    held, ratio = 0, []
    for seed in range(40):
        rows = fitted(gain(0.02, n=60, seed=seed), JointGain(2))
        interval = of(rows, JointGain)
        held += interval.low <= 0.02 <= interval.high
        slot = next(k for k, s in enumerate(rows.slots) if isinstance(s.owner, JointGain))
        ratio.append((interval.high - interval.low) / (2 * 1.96 * rows.standard_errors[slot]))
    assert held >= 34
    assert 1.0 <= np.median(ratio) < 1.3


def test_what_is_there_is_as_large_as_the_data_say() -> None:
    """A gain of ten times its prior, few rows: its prior would pull the interval off the truth."""
    rows = fitted(gain(0.5, n=14), JointGain(2))
    slot = next(s for s in rows.slots if isinstance(s.owner, JointGain))
    assert 5 * float(prior_widths((slot,))[0]) < 0.5
    free, pulled = of(rows, JointGain), of(rows, JointGain, found=False)
    assert free.low < 0.5 < free.high
    assert free.high > pulled.high


def test_where_else_it_could_have_come_out_makes_it_wider() -> None:
    rows = fitted(gain(0.02, n=40), JointGain(2))
    places = tuple(Candidate("joint_gain", (JointGain(j),)) for j in (1, 2, 4))
    alone, beside = of(rows, JointGain), of(rows, JointGain, library_=places)
    assert beside.high - beside.low > 1.02 * (alone.high - alone.low)
    other = (Candidate("joint_compliance", (JointCompliance(4),)),)
    assert of(rows, JointGain, library_=other) == alone


def moved(model: Model, other: Backlash) -> Model:
    effects = tuple(other if t.key == other.key else t for t in model.effects)
    return dataclasses.replace(model, effects=effects)


def test_a_scale_of_a_form_may_be_half_the_way_to_the_next() -> None:
    """Where play sets in: the rows change as the model's do, between the values tried."""
    play = Backlash(6, gate=0.3, blend=0.2, width=0.03)
    data = session_of(DEMO, 1, play)
    base = Model(DEMO, (LinkDeflection(), *geometry_terms(DEMO, data)))
    rows = fit_model(base.plus(play), data, sigma=np.full(3, 4e-4))
    (term,) = (t for t in rows.model.terms if isinstance(t, Backlash))
    tried = [Backlash(6, gate=g, blend=b) for g, b in ((0.1, 0.2), (0.4, 0.2), (0.3, 0.5))]
    forms = [Candidate(play.name, (t,)) for t in tried]
    gate, blend = _change_of_scales(rows, FitColumns(rows), [term], forms)
    for found, field, way in ((gate, "gate", -0.15), (blend, "blend", 0.245)):
        here, known = getattr(term, field), rows.session.context()
        other = dataclasses.replace(term, **{field: here + way})
        change = moved(rows.model, other).tip(data.q, known) - rows.model.tip(data.q, known)
        assert np.linalg.norm(found[..., 0] - change) < 0.05 * np.linalg.norm(change)


@pytest.mark.parametrize("lasts", [1, 8])
def test_noise_that_lasts_makes_it_wider(lasts: int) -> None:
    """Rows in runs that share their noise and their poses tell less than the fit believes."""
    rng = np.random.default_rng(4)
    data = gain(0.02, n=160, seed=4)
    order = np.argsort(data.q[:, 1])
    noise = np.repeat(SIGMA * rng.standard_normal((160 // lasts, 3)), lasts, axis=0)
    rows = Session.record(data.q[order], data.xyz[order] + 3 * noise)
    made = fitted(rows, JointGain(2))
    slot = next(k for k, s in enumerate(made.slots) if isinstance(s.owner, JointGain))
    interval = of(made, JointGain)
    ratio = (interval.high - interval.low) / (2 * 1.96 * made.standard_errors[slot])
    assert (ratio > 3.5) == (lasts > 1)


def test_it_ends_at_the_bound_and_says_so() -> None:
    """No joint is softer than nothing."""
    rows = fitted(session(n=60), JointCompliance(2))
    slot = next(s for s in rows.slots if isinstance(s.owner, JointCompliance))
    interval = of(rows, JointCompliance)
    assert slot.parameter.lower == 0.0
    assert 0.0 <= interval.low <= interval.value <= interval.high
    assert interval.low == 0.0
    inside = of(fitted(gain(0.02), JointGain(2)), JointGain)
    assert not inside.at_bound


def test_what_moves_an_estimate_widens_its_interval_on_both_sides() -> None:
    """The rows, with all that could be otherwise, ask for another value than the model has."""
    rows = fitted(gain(0.02, n=80), JointGain(2))
    slot = next(k for k, s in enumerate(rows.slots) if isinstance(s.owner, JointGain))
    off = 8.0 * rows.standard_errors[slot]
    asked = dataclasses.replace(rows, residual=rows.residual + off * rows.columns[..., slot])
    interval = of(asked, JointGain)
    assert interval.low < interval.value < interval.value + off < interval.high
    assert interval.low + interval.high == pytest.approx(2.0 * interval.value)
