"""No probability is lost: where onsets merge, where a posterior splits, where branches merge."""

import dataclasses

import numpy as np
import pytest
from at_work_arm import Work, fitted

from longarm_comp.core.at_work import posterior
from longarm_comp.core.at_work.changes import Parameters
from longarm_comp.core.at_work.explanations import MOST, Branch, Explanations, _PastChange
from longarm_comp.core.at_work.posterior import RecursivePosterior
from longarm_comp.core.at_work.row import Row
from longarm_comp.core.identify.posterior.found import UNNAMED


def begun() -> RecursivePosterior:
    """Before any sighting, with six parameters that are not known exactly."""
    space = Parameters.of(fitted(), Work().pose()[1])
    return RecursivePosterior.begin(space, space.values(fitted()), np.arange(6), 1e-8 * np.eye(6))


def row(number: int, columns: np.ndarray, off: np.ndarray) -> Row:
    """A sighting that is off by so much from what `begun` expects, m."""
    value = columns @ begun().mean + off
    return Row(float(number), columns, value, 1e-8 * np.eye(3), 1.0)


def test_merged_onsets_are_as_probable_as_all_their_sightings() -> None:
    """By sightings that tell nothing: a change is as probable as before, once for each of them."""
    known = begun()
    nothing = np.zeros((3, len(known.space)))
    for k in range(40):
        known = known.update(row(k, nothing, np.zeros(3)))
    assert len(known.since) < 40 and known.span.sum() == 40
    np.testing.assert_array_equal(np.diff(known.since), known.span[1:])
    named, unnamed = (posterior._HAZARD * share for share in (1.0 - UNNAMED, UNNAMED))
    possible = known.possible
    assert np.exp(possible.log_weight).sum() == pytest.approx(40 * named)
    assert np.exp(possible.unnamed - known.growth).sum() == pytest.approx(40 * unnamed)


def test_a_split_loses_no_probability() -> None:
    """Eight effects explain the sightings alike: the half that is not split stays as it was."""
    known, rng = begun(), np.random.default_rng(0)
    space = known.space
    alike = [k for k, s in enumerate(space.slots) if s.owner.name in ("joint_zero", "joint_gain")]
    first, taken = Branch(1.0, known), 0
    while True:
        columns = np.zeros((3, len(space)))
        columns[:, alike] = rng.standard_normal((3, 1)) * 1e-3 / space.widths[alike]
        off = columns[:, alike[0]] * space.widths[alike[0]]
        first = dataclasses.replace(
            first, posterior=first.posterior.update(row(taken, columns, off))
        )
        taken, made = taken + 1, list(first.split())
        if len(made) > 1:
            break
        assert taken <= 15
    chance = first.posterior.probability.sum(axis=0)
    *named, rest = made
    split = [space.keys.index(b.changes[0].key) for b in named]
    assert len(named) == MOST - 1 and rest.changes == ()
    assert [b.weight for b in named] == pytest.approx(chance[split].tolist())
    assert sum(b.weight for b in made) == pytest.approx(1.0) and rest.weight > 0.3
    left = rest.posterior.probability.sum(axis=0)
    others = np.setdiff1d(np.arange(len(chance)), split)
    np.testing.assert_allclose(left[others], chance[others] / rest.weight)
    assert not left[split].any()
    again = rest.posterior.update(row(taken, columns, off))  # from now on they may change again
    ruled_out = np.isneginf(again.possible.log_weight[:, split])
    assert ruled_out[:-1].all() and not ruled_out[-1].any()


def test_explanations_that_merge_keep_their_moments() -> None:
    known = begun()
    away = 1e-3 * np.arange(6.0)
    moved = dataclasses.replace(known, mean=known.mean + np.pad(away, (0, len(known.mean) - 6)))
    changed = [
        (_PastChange(key, known.space.where(c), 0.0, 2, (0.0,)),)
        for c, key in enumerate(known.space.keys[:3])
    ]
    branches = (
        Branch(0.3, known),
        *(Branch(0.17, known, each) for each in changed),
        Branch(0.19, moved),
    )
    nothing = row(0, np.zeros((3, len(known.space))), np.zeros(3))
    merged = next(b for b in Explanations(branches).update(nothing).branches if not b.changes)
    share = 0.19 / 0.49
    assert merged.weight == pytest.approx(0.49)
    np.testing.assert_allclose((merged.posterior.mean - known.mean)[:6], share * away)
    more = merged.posterior.covariance - known.covariance
    np.testing.assert_allclose(more, share * (1.0 - share) * np.outer(away, away), atol=1e-15)
