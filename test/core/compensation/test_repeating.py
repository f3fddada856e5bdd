"""Errors that repeat: the drift monitor takes them for the model's, as promised, and no change."""

import dataclasses
from functools import cache

import numpy as np
import pytest
from known_arm import RIGID, calibrated
from read_arm import ARM
from told_payloads import ARM as DEMO
from told_payloads import loaded

from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.drift import Monitor
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.compensation.repeating import RepeatingErrors
from longarm_comp.core.compensation.sighting import PAYLOAD, SHARED, error_of_sighting
from longarm_comp.core.compensation.weighing import SD
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.uncertainty import factor_of

LEFT, FRAME, SEEN = 1.5e-3, 1e-3, 2e-4
"""Standard deviations per axis of the error that no parameter explains, of the frame, of the
sensor, m."""
QUIET = 60
"""Number of rests in a run."""


@cache
def promising() -> Model:
    """An arm that is promised to some 2 mm per axis."""
    model = calibrated(RIGID, "wide")
    assert model.uncertainty is not None
    record = dataclasses.replace(
        model.uncertainty,
        factor=3.0 * model.uncertainty.factor,
        structure=LEFT**2 * np.eye(3),
        frame=FRAME**2 * np.eye(3),
        noise=SEEN**2 * np.eye(3),
    )
    return dataclasses.replace(model, uncertainty=record)


@cache
def begun() -> RepeatingErrors:
    return RepeatingErrors.of(promising())


def rests(
    seed: int, poses: int, alike: float, off: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> tuple[int | None, RepeatingErrors]:
    """A run of rests whose errors are drawn from the promise, over `poses` poses in turn.

    Args:
        alike: share of the variance of what no parameter explains that all poses have in common;
            the rest is each pose's own.
        off: m, change of the tip after the run, for as many rests again.

    Returns:
        The number of the rest at which the alarm was raised, and the errors as known then.
    """
    rng = np.random.default_rng(seed)
    q = ARM.lower + rng.random((poses, ARM.n)) * (ARM.upper - ARM.lower)
    record, known, monitor = begun().promised, begun(), Monitor(run_length=1e4)
    factor = record.factor[[record.row[slot.identity] for slot in known.slots]]
    wrong = factor @ rng.standard_normal(factor.shape[1])
    shift = FRAME * rng.standard_normal(3) + np.sqrt(alike) * LEFT * rng.standard_normal(3)
    own = np.sqrt(1.0 - alike) * LEFT * rng.standard_normal((poses, 3))
    model = known.model
    for k in range(QUIET * (2 if any(off) else 1)):
        here = q[k % poses]
        point, columns = model.columns(model.posture(tuple(here.tolist()), Context()), known.slots)
        tip = point.reshape(3) + columns.reshape(3, -1) @ wrong + shift + own[k % poses]
        tip = tip + SEEN * rng.standard_normal(3) + (np.array(off) if k >= QUIET else 0.0)
        found = known.compare(here, Context(), tip, np.full(3, SEEN**2))
        monitor = monitor.seen(found.off, found.spread(0.0))
        if monitor.verdict().drifted:
            return k, known
        known = found.after
    return None, known


@pytest.mark.parametrize(
    ("poses", "alike"), [(1, 0.0), (4, 0.3), (QUIET, 0.5)], ids=["one", "four", "ever new"]
)
def test_what_the_promise_holds_raises_no_alarm(poses: int, alike: float) -> None:
    """At one false alarm in 10,000 rests; as independent samples, half of these runs had one."""
    assert [rests(seed, poses, alike)[0] for seed in range(6)] == [None] * 6


@pytest.mark.parametrize("poses", [4, QUIET])
def test_a_change_within_the_promise_is_found_once_the_errors_are_known(poses: int) -> None:
    """Of 4 mm, where 90 of 100 errors are promised to be below 5 mm."""
    tip = promising().tip(ARM.mid[None])
    assert expected_miss(promising(), ARM.mid[None], Context(), tip).sizes[1] > 4e-3
    for seed in range(3):
        alarm, _ = rests(seed, poses, 0.3, (4e-3, 0.0, 0.0))
        assert alarm is not None and QUIET <= alarm <= QUIET + 15


def test_what_is_expected_is_as_in_a_whole_regression() -> None:
    """Two poses in turn, and two payloads, each known to a standard deviation of its own."""
    model = loaded()
    assert model.uncertainty is not None
    record = dataclasses.replace(model.uncertainty, frame=FRAME**2 * np.eye(3))
    known = RepeatingErrors.of(dataclasses.replace(model, uncertainty=record))
    poses, rng, variance = sobol(DEMO, 2, 3).q, np.random.default_rng(0), np.full(3, SEEN**2)
    factor = record.factor[[record.row[slot.identity] for slot in known.slots]]
    each, noises, offs = [], [], np.zeros(0)
    for pose, kg in ((0, 0.3), (1, 0.3), (0, 0.4), (0, 1.0), (1, 1.0)):
        q, here = poses[pose], Context(columns={"payload_kg": kg, SD: 0.1})
        error = error_of_sighting(model, record, q, here, variance)
        at = model.posture(tuple(q.tolist()), here)
        point, columns = model.columns(at, known.slots)
        left = np.sqrt(SHARED) * factor_of(error.structure)
        of_payload, of_pose = np.zeros((2, 3, 1)), np.zeros((2, 3, 3))
        of_payload[int(kg > 0.5)], of_pose[pose] = error.common[:, PAYLOAD:], left
        shared = (error.common[:, :PAYLOAD], *of_payload, left, *of_pose)
        each.append(np.hstack([columns.reshape(3, -1) @ factor, *shared]))
        off = 1e-3 * rng.standard_normal(3)
        found = known.compare(q, here, point.reshape(3) + off, variance)
        known, offs = found.after, np.append(offs, off)
        whole = np.concatenate(each)
        spread = whole @ whole.T
        noises.append(error.noise + error.structure)
        for k, noise in enumerate(noises):
            spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += noise
        before = np.linalg.solve(spread[:-3, :-3], spread[:-3, -3:])
        np.testing.assert_allclose(found.off, off - before.T @ offs[:-3], atol=1e-9)
        left_open = spread[-3:, -3:] - before.T @ spread[:-3, -3:]
        np.testing.assert_allclose(found.covariance, left_open, rtol=1e-6, atol=1e-12)


def test_a_spread_has_a_least_size_and_turns_with_the_frame() -> None:
    q = ARM.mid
    found = begun().compare(q, Context(), promising().measured(q), np.full(3, SEEN**2))
    values, axes = np.linalg.eigh(found.covariance)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = found.spread(0.0, turn)
    np.testing.assert_allclose(turned, turn @ found.covariance @ turn.T, atol=1e-15)
    middle = float(np.sqrt(values[1]))
    least = axes.T @ found.spread(middle) @ axes
    np.testing.assert_allclose(least, np.diag(values[[1, 1, 2]]), atol=1e-15)
