"""What no parameter explains goes on away from the rows, and the promise knows it."""

from pathlib import Path

import numpy as np
import pytest
from hidden_arm import SIGMA, calibrated
from numpy.polynomial.legendre import legval
from small_arm import ARM

from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.uncertainty import with_uncertainty
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.compensation.unshown import structure_left
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.domain import ROUGH, SMOOTH, RowDomain, least_moved
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import restore, save_model, store
from longarm_comp.core.model.uncertainty import ModelUncertainty
from longarm_comp.nodes.model_files import ModelFiles
from longarm_comp.sim.arm_truth import TrueArm
from longarm_comp.sim.hidden.drives import GearEccentricity

WAVE = np.array([0.0, 8e-3, 0.0, 0.0])
TRUTH = TrueArm(ARM, [GearEccentricity(np.array([0.0 * WAVE, WAVE]), np.full((2, ARM.n), 0.7))])


def test_a_parabola_goes_on_outside_its_range() -> None:
    """The third joint stood still: its rows tell nothing of how an error varies with it."""
    square = np.diag([1.0, 2.0, 3.0])
    ranges = {"q1": (-0.5, 1.5), "q2": (0.0, 1.0), "q3": (0.2, 0.2001), "payload_kg": (0.0, 1.0)}
    record = ModelUncertainty((), np.zeros((0, 0)), square, square, 1e-3, 9, circumstances=ranges)
    q = np.array([[0.0, 0.5, 0.9], [-0.5, 1.0, -3.0], [1.9, 0.5, 0.2], [-1.5, 1.3, 0.2]])
    rise = [(legval(1.0 + 2.0 * e, [0.0, 0.0, 1.0]) - 1.0) ** 2 / 0.2 for e in (0.2, 0.5, 0.3)]
    grown = np.array([0.0, 0.0, rise[0], rise[1] + rise[2]]) / 3.0 + 1.0
    found = record.structure_at(q, np.full(3, 0.1))
    np.testing.assert_allclose(found, grown[:, None, None] * square)


def test_an_error_grows_with_the_distance_from_the_rows(rng: np.random.Generator) -> None:
    """Half of it is the variance of a Gaussian process at new joints; the third joint stood."""
    rows = rng.random((40, 3)) * [2.0, 0.5, 1e-3] + [1.0, -4.0, 0.2]
    domain = RowDomain.of(rows, np.full(3, 0.1))
    assert len(domain.q) == 40 and domain.span[2] == np.inf
    x, span = rng.random((5, 3)) * 3.0, np.ptp(rows, axis=0)[:2]

    def alike(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        apart = (a[:, None, :2] - b[None, :, :2]) / (SMOOTH * span)
        return np.exp(-0.5 * (apart**2).sum(axis=-1))

    def variance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        known = np.linalg.inv(alike(b, b) + ROUGH * np.eye(len(b)))
        return 1.0 + ROUGH - np.einsum("ai,ij,aj->a", alike(a, b), known, alike(a, b))

    amid = [variance(rows[[k]], np.delete(rows, k, axis=0)) for k in range(40)]
    grown = 0.5 + 0.5 * variance(x, rows) / np.median(amid)
    assert grown.min() > 1.0
    np.testing.assert_allclose(domain.growth_at(x), grown, rtol=1e-6)
    assert np.median(domain.growth_at(rows)) == domain.growth_at(rows).min() == 1.0


def test_a_place_beside_the_rows_tells_more_and_one_amid_them_nothing() -> None:
    along = np.linspace(0.0, 1.0, 30)[:, None] * [1.0, 1.0]
    domain = RowDomain.of(along, np.zeros(2))
    beside = np.array([0.2, 0.8])
    more = domain.plus(beside)
    near = beside[None] + 0.02
    assert more.amid == domain.amid and len(more.q) == len(domain.q) + 1
    assert more.growth_at(near)[0] < 0.1 * domain.growth_at(near)[0]
    assert more.plus(np.array([0.405, 0.405])) is more


def test_the_places_are_those_farthest_apart(rng: np.random.Generator) -> None:
    crowd = np.repeat(0.01 * rng.random((40, 2)), 10, axis=0)
    corners = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    domain = RowDomain.of(np.concatenate([crowd, corners]), np.zeros(2))
    assert len(domain.q) == 43
    assert {tuple(q) for q in domain.q[1:4]} == {tuple(q) for q in corners}


@pytest.mark.parametrize("width", [0.1, 0.3])
def test_beside_a_band_of_rows_the_promise_holds(width: float) -> None:
    """Joints that went together fill no box: 41 to 82 % of its commands were inside."""
    turns = np.array([2e-3, 2e-3, 0.0, 2e-3])
    truth = TrueArm(ARM, [GearEccentricity(np.array([0.0 * turns, turns]), np.full((2, 4), 0.7))])
    fresh = ARM.lower + np.random.default_rng(9).random((300, 4)) * (ARM.upper - ARM.lower)
    inside, times = [], []
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        along = rng.random((150, 1)) + width * (rng.random((150, 4)) - 0.5)
        q = ARM.lower + np.clip(along, 0.0, 1.0) * (ARM.upper - ARM.lower)
        rows = Session.record(q, truth.tip(q) + SIGMA * rng.standard_normal((150, 3)))
        model = with_uncertainty(calibrated(rows))
        predicted = model.tip(fresh, Context())
        off = np.linalg.norm(truth.tip(fresh) - predicted, axis=1)
        radius = expected_miss(model, fresh, Context(), predicted).sizes[1]
        inside.append((off <= radius).mean())
        times.append(np.median(radius) / np.median(off))
        rows_radius = expected_miss(model, q, Context(), model.tip(q, Context())).sizes[1]
        assert np.median(rows_radius) < 3.0 * SIGMA
    assert min(inside) >= 0.85 and max(times) < 6.0


def test_a_file_that_does_not_say_where_its_rows_stood_promises_as_before(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    q = ARM.lower + rng.random((60, ARM.n)) * (ARM.upper - ARM.lower)
    made = with_uncertainty(calibrated(Session.record(q, TRUTH.tip(q))))
    stored = store(made)
    assert stored.uncertainty is not None
    places = RowDomain.of(q, np.zeros(ARM.n)).q
    back = restore(stored, ARM, "model.yaml").uncertainty
    assert back is not None and back.domain is not None
    np.testing.assert_allclose(back.domain.q, places, rtol=1e-6)
    before = stored.model_copy(
        update={"uncertainty": stored.uncertainty.model_copy(update={"domain": None})}
    )
    model: Model = restore(before, ARM, "model.yaml")
    assert model.uncertainty is not None and model.uncertainty.domain is None
    there = model.uncertainty.structure_at(q[:3], np.zeros(ARM.n))
    np.testing.assert_allclose(there, np.tile(model.uncertainty.structure, (3, 1, 1)))
    arm, path = tmp_path / "arm.yaml", tmp_path / "model.yaml"
    arm.write_text(ARM.model_dump_json(exclude_defaults=True))
    for each, said in ((before, True), (stored, False)):
        save_model(path, each)
        message = ModelFiles(str(arm), str(path)).report().message
        assert ("does not say where its rows stood" in message) is said


@pytest.mark.parametrize("line", ["not base 64", "AADAfw==", "AACAPw=="])
def test_places_that_are_no_joints_are_refused(line: str) -> None:
    """The second is not a number, the third a joint fewer rows than the others."""
    rng = np.random.default_rng(3)
    q = ARM.lower + rng.random((40, ARM.n)) * (ARM.upper - ARM.lower)
    stored = store(with_uncertainty(calibrated(Session.record(q, TRUTH.tip(q)))))
    assert stored.uncertainty is not None
    assert stored.uncertainty.domain is not None
    stored.uncertainty.domain.places[1] = line
    with pytest.raises(InputError, match=r"uncertainty\.domain"):
        restore(stored, ARM, "model.yaml")


@pytest.mark.parametrize("turns", [0.0, 0.5])
@pytest.mark.parametrize("share", [0.12, 0.25])
def test_a_little_way_of_a_joint_does_not_make_the_promise_useless(
    share: float, turns: float
) -> None:
    """What rows so near each other leave may be noise; 9 and 2.5 mm were promised."""
    hidden = GearEccentricity(turns * np.array([0.0 * WAVE, WAVE]), np.full((2, ARM.n), 0.7))
    truth, rng = TrueArm(ARM, [hidden]), np.random.default_rng(1)
    fresh, q = (ARM.lower + rng.random((n, ARM.n)) * (ARM.upper - ARM.lower) for n in (300, 120))
    q[:, 1] = ARM.mid[1] + share * (q[:, 1] - ARM.mid[1])
    rows = Session.record(q, truth.tip(q) + SIGMA * rng.standard_normal((120, 3)))
    model = with_uncertainty(calibrated(rows))
    assert model.uncertainty is not None
    beyond = fresh[np.abs(fresh[:, 1] - ARM.mid[1]) > np.abs(q[:, 1] - ARM.mid[1]).max()]
    predicted = model.tip(beyond, Context())
    off = np.linalg.norm(truth.tip(beyond) - predicted, axis=1)
    radius = expected_miss(model, beyond, Context(), predicted).sizes[1]
    assert (off <= radius).mean() >= 0.9 and np.median(radius) < 14.0 * SIGMA
    near = structure_left(model, model.uncertainty, q, Context())
    grown = model.uncertainty.structure_at(q, least_moved(ARM))
    amid = np.einsum("kii->k", grown) <= 2.0 * np.trace(model.uncertainty.structure)
    np.testing.assert_allclose(near[amid], grown[amid])


@pytest.mark.parametrize("stored", [False, True])
def test_beyond_the_rows_the_promise_holds(stored: bool) -> None:
    """Rows of the lower half of joint 2 hardly show that its gears run out of round.

    All of the error is this joint's, not its share: 0.7 are inside, 0.015 were.
    """
    rng = np.random.default_rng(3)
    upper = np.where(np.arange(ARM.n) == 1, ARM.mid, ARM.upper)
    q = ARM.lower + rng.random((120, ARM.n)) * (upper - ARM.lower)
    rows = Session.record(q, TRUTH.tip(q) + SIGMA * rng.standard_normal((120, 3)))
    model = with_uncertainty(calibrated(rows))
    if stored:
        model = restore(store(model), ARM, "model.yaml")
    fresh = ARM.lower + rng.random((400, ARM.n)) * (ARM.upper - ARM.lower)
    predicted = model.tip(fresh, Context())
    off = np.linalg.norm(TRUTH.tip(fresh) - predicted, axis=1)
    radius = expected_miss(model, fresh, Context(), predicted).sizes[1]
    inside, beyond = off <= radius, fresh[:, 1] > ARM.mid[1]
    assert inside[beyond].mean() >= 0.65 and inside[~beyond].mean() >= 0.85
    assert np.median(radius[beyond]) < 6.0 * np.median(off[beyond])
    assert np.median(radius[~beyond]) < 3.0 * SIGMA
