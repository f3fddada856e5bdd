"""The posterior over explanations: its sums against plain integrals, and planted effects."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from demo_rows import session_of

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.calibration.linear import choose_sizes
from longarm_comp.core.effects.compliances import JointCompliance, ServoDroop
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.fields import ALIKE
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.shapes import Cosine, FunctionError
from longarm_comp.core.identify.posterior.ascent import find_explanation
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.identify.posterior.explained import ExplainedSession
from longarm_comp.core.identify.posterior.found import NONE, UNNAMED
from longarm_comp.core.identify.posterior.offer import Offer, OtherEffects, SingleEffect
from longarm_comp.core.identify.posterior.offer_bank import OfferBank
from longarm_comp.core.identify.posterior.offer_table import Coefficients
from longarm_comp.core.model.model import Model

UNBOUND = np.full(9, np.inf)


def bank(y: np.ndarray, x: np.ndarray, offers: list[Offer], upper: np.ndarray) -> OfferBank:
    own = Coefficients(-UNBOUND[: x.shape[1]], upper, np.arange(x.shape[1]))
    return OfferBank(offers, x.T @ x, x.T @ y, own)


def single(name: str, column: int, **more: object) -> Offer:
    made = Offer(name, (name,), ((column,),), math.log(0.1))
    return dataclasses.replace(made, **more)  # type: ignore[arg-type]


@pytest.fixture
def columns() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((80, 3))


def test_the_evidence_is_that_of_the_integral_over_sizes_and_bounds(columns: np.ndarray) -> None:
    y = 0.36 * columns[:, 0] + np.random.default_rng(1).standard_normal(80)
    sizes, chances = (1.0, 4.0), (math.log(0.6), math.log(0.4))
    upper = np.array([0.4, np.inf, np.inf])
    offer = single("a", 0, sizes=sizes, chances=chances)
    found = bank(y, columns, [offer], upper).compute_single_effect(columns.T @ y, OtherEffects())
    b = np.linspace(-40.0, 0.4, 400_001)
    likelihood = b * (columns[:, 0] @ y) - 0.5 * b * b * (columns[:, 0] @ columns[:, 0])
    odds = 0.0
    for size, chance in zip(sizes, chances, strict=True):
        prior = np.exp(-0.5 * (b / size) ** 2)
        odds += (
            math.exp(chance) * np.trapezoid(np.exp(likelihood) * prior, b) / np.trapezoid(prior, b)
        )
    odds *= 0.1 * math.exp(-NONE)
    assert 0.1 < odds < 10.0
    assert found.presence / (1.0 - found.presence) == pytest.approx(odds, rel=0.02)
    assert found.mean[0] <= 0.4


def integral(rest: np.ndarray, x: np.ndarray, size: float, upper: float = np.inf) -> float:
    """Log evidence of one column with a normal prior up to a bound, by quadrature."""
    b = np.linspace(-12.0 * size, min(12.0 * size, upper), 200_001)
    log = b * (x @ rest) - 0.5 * b * b * (x @ x)
    prior = np.exp(-0.5 * (b / size) ** 2)
    top = log.max()
    return float(top + np.log(np.trapezoid(np.exp(log - top) * prior, b) / np.trapezoid(prior, b)))


@pytest.fixture
def across() -> np.ndarray:
    """(80, 4) columns that tell nothing of each other."""
    made = np.linalg.qr(np.random.default_rng(7).standard_normal((80, 4)))[0]
    return made * [9.0, 6.0, 4.0, 0.3]


def test_the_joint_evidence_is_that_of_the_integral_with_priors_paid(across: np.ndarray) -> None:
    """One that is whole or not, one within bounds, one that may be large, one that is."""
    y = across @ [1.0, 0.9, 1.5, 40.0] + np.random.default_rng(8).standard_normal(80)
    upper = np.array([np.inf, 0.8, np.inf, np.inf])
    more = {"sizes": (1.0, 16.0), "chances": (math.log(0.7), math.log(0.3))}
    offers = [
        single("whole", 0, fixed=True),
        single("bounded", 1, **more),
        single("small", 2, **more),
        single("large", 3, **more),
    ]
    of = bank(y, across, offers, upper)
    evidence, values = of.solve_together(offers)
    expected = across[:, 0] @ y - 0.5 * across[:, 0] @ across[:, 0]
    expected += integral(y, across[:, 1], 1.0, 0.8) + math.log(0.7)
    expected += integral(y, across[:, 2], 1.0) + math.log(0.7)
    expected += integral(y, across[:, 3], 16.0) + math.log(0.3)
    expected += 4 * (math.log(0.1) - NONE)
    assert evidence == pytest.approx(expected, abs=0.02)
    assert of.evidence([]) == 0.0
    assert values[0] == [1.0]
    assert values[1][0] <= 0.8
    assert values[3][0] > 25.0  # one of the size of its prior would be 3


def test_coefficients_that_are_like_each_other_have_the_evidence_of_their_prior(
    across: np.ndarray,
) -> None:
    """Against the plain normal law; in bounds, less the mass of what both priors allow."""
    x, n = across[:, 1:3], len(across)
    y = x @ [1.0, 1.4] + np.random.default_rng(8).standard_normal(n)
    offer = Offer("seat", ("seat",), ((0, 1),), 0.0)
    likeness = np.array([[1.0, ALIKE], [ALIKE, 1.0]])

    def of(lower: float) -> OfferBank:
        alike = Coefficients(np.full(2, lower), UNBOUND[:2], np.zeros(2, dtype=int))
        return OfferBank([offer], x.T @ x, x.T @ y, alike)

    spread = np.eye(n) + x @ likeness @ x.T
    plain = 0.5 * (y @ y - y @ np.linalg.solve(spread, y) - np.linalg.slogdet(spread)[1]) - NONE
    assert of(-np.inf).evidence([offer]) == pytest.approx(plain, abs=1e-6)
    assert of(-np.inf).scores == pytest.approx([plain], abs=1e-6)
    both = math.log(0.25 + math.asin(ALIKE) / (2.0 * math.pi))
    assert of(0.0).evidence([offer]) == pytest.approx(plain - both, abs=0.02)
    assert of(0.0).scores == pytest.approx([plain - both], abs=0.02)


def test_what_is_alike_has_one_size() -> None:
    mean, sizes = np.array([6.0, 0.5, 0.5]), np.ones((3, 1)) * (1.0, 4.0)
    chances = np.ones((3, 1)) * np.log((0.8, 0.2))
    alone, cost = choose_sizes(mean, sizes, chances)
    assert (alone.tolist(), cost) == ([4.0, 1.0, 1.0], pytest.approx(math.log(0.2 * 0.8 * 0.8)))
    paired, cost = choose_sizes(mean, sizes, chances, np.array([0, 0, 2]))
    assert (paired.tolist(), cost) == ([4.0, 4.0, 1.0], pytest.approx(math.log(0.2 * 0.8)))


def test_functions_at_one_place_are_one_cause(across: np.ndarray) -> None:
    """The second needs no effect, cause or place of its own: half of the causes have one more."""
    x, y = across[:, :3], across[:, :3] @ [0.5, 0.5, 0.5]
    offers = [
        single("no name", k, keys=(k,), site=site, log_prior=math.log(UNNAMED / 30))
        for k, site in enumerate(("joint 1", "joint 1", "joint 2"))
    ]
    own = Coefficients(-UNBOUND[:3], UNBOUND[:3], np.arange(3))
    of = OfferBank(offers, x.T @ x, x.T @ y, own, sites=3)
    alone = of.evidence(offers[:1]) - (offers[0].log_prior - NONE)
    elsewhere = of.evidence(offers[::2]) - of.evidence(offers[2:])
    there = of.evidence(offers[:2]) - of.evidence(offers[1:2])
    assert elsewhere == pytest.approx(alone + offers[0].log_prior - NONE + of.same_name)
    assert there == pytest.approx(alone + math.log(0.5) - math.log(30 / 3))
    others = OtherEffects(*(frozenset({each}) for each in (2, 1, "no name", "joint 1")))
    beside = of.compute_single_effect(x.T @ y, others)
    assert beside.probabilities[0] / (1.0 - beside.presence) == pytest.approx(math.exp(there))


@pytest.mark.parametrize(("angle", "named"), [(0.02, True), (0.04, False)])
def test_a_function_that_does_what_a_name_does_is_no_other_cause(
    across: np.ndarray, angle: float, named: bool
) -> None:
    ways = np.linalg.qr(across[:, :2])[0]
    x = np.column_stack([3.0 * ways[:, 0], ways @ [math.cos(angle), math.sin(angle)]])
    function = single("no name", 1, site="joint 1")
    of = bank(x[:, 0], x, [single("gain", 0), function], UNBOUND[:2])
    assert of.imitates_a_name(function) == named
    assert not of.imitates_a_name(of.offers[0])


def test_what_is_there_whole_is_taken_off_before_the_rest(across: np.ndarray) -> None:
    """A column that runs with it explains nothing more."""
    x = np.column_stack([across[:, 0], across[:, 0] + 0.2 * across[:, 1]])
    y = across[:, 0] + 0.1 * np.random.default_rng(9).standard_normal(80)
    whole, beside = single("whole", 0, fixed=True), single("beside", 1)
    of = bank(y, x, [whole, beside], UNBOUND[:2])
    left = integral(y - x[:, 0], x[:, 1], 1.0)
    assert of.evidence([whole, beside]) - of.evidence([whole]) == pytest.approx(
        left + math.log(0.1) - NONE, abs=0.02
    )


def test_a_single_effect_that_is_whole_has_the_odds_of_its_likelihood(across: np.ndarray) -> None:
    y = 0.55 * across[:, 0] + 0.1 * across[:, 1]
    whole = single("whole", 0, fixed=True)
    found = bank(y, across[:, :1], [whole], UNBOUND[:1]).compute_single_effect(
        across[:, :1].T @ y, OtherEffects()
    )
    log_odds = 0.55 * 81.0 - 0.5 * 81.0 + math.log(0.1) - NONE
    assert math.log(found.presence / (1.0 - found.presence)) == pytest.approx(log_odds, abs=1e-6)
    assert found.mean[0] == pytest.approx(found.presence)


def test_a_further_place_of_a_name_has_half_of_the_probability(across: np.ndarray) -> None:
    """Of six names: three times as likely as any single other."""
    first = single("a", 0)
    second = dataclasses.replace(single("a", 1), keys=("there",))
    others = [single(name, 1) for name in "bcdef"]
    y = across @ [2.0, 1.0, 0.0, 0.0]
    of = bank(y, across[:, :2], [first, second, *others], UNBOUND[:2])
    gap = of.evidence([first, second]) - of.evidence([first, others[0]])
    assert gap == pytest.approx(math.log(3.0))
    rest = of.along - of.gram @ [2.0, 0.0]
    a = frozenset({"a"})
    beside = of.compute_single_effect(rest, OtherEffects(held=a, names=a))
    assert beside.probabilities[1] == pytest.approx(3.0 * beside.probabilities[2])
    assert beside.probabilities[0] == 0.0
    shut = of.compute_single_effect(rest, OtherEffects(frozenset({1}), a, a))
    assert shut.probabilities[1] == 0.0
    assert shut.probabilities[2] == pytest.approx(1.0 / 5.0, abs=0.01)


def test_of_names_that_rounding_alone_distinguishes_the_first_is_named() -> None:
    offers = [single(name, 0) for name in "abc"]
    q = np.array([1.0 / 3.0, 1.0 / 3.0 + 1e-12, 1.0 / 3.0 - 1e-12])
    assert SingleEffect(offers, q, np.zeros(1)).best == 0
    assert SingleEffect(offers, q + np.array([0.0, 1e-3, 0.0]), np.zeros(1)).best == 1


def test_others_leave_their_places_and_names_where_they_are_more_likely_there_than_not() -> None:
    offers = [single("a", 0), single("b", 1, site="joint 1")]
    each = [SingleEffect(offers, np.array(q), np.zeros(2)) for q in ([0.4, 0.0], [0.0, 0.6])]
    shut = frozenset({7})
    assert OtherEffects.of(each, shut) == OtherEffects(
        shut, *(frozenset({x}) for x in ("b", "b", "joint 1"))
    )


def test_a_coefficient_between_far_bounds_is_as_one_without_bounds(columns: np.ndarray) -> None:
    """And one bound of an offer of two columns lowers the score of this offer alone."""
    pair = Offer("b", ("b", "c"), ((1,), (2,)), NONE)
    y = columns @ [2.0, 2.0, 1.0]
    free, far, near = (
        bank(y, columns, [single("a", 0), pair], np.array([np.inf, end, np.inf])).scores
        for end in (np.inf, 30.0, 0.5)
    )
    assert far == pytest.approx(free, abs=1e-12)
    assert near[0] == pytest.approx(free[0], abs=1e-12)
    assert near[1] < free[1] - 1.0


def test_a_restart_leaves_a_local_optimum() -> None:
    """One column imitates the sum of two: uphill it comes first and, alone, it would stay."""
    rng = np.random.default_rng(5)
    x = rng.standard_normal((100, 3))
    x[:, 2] = x[:, 0] + x[:, 1] + 0.3 * rng.standard_normal(100)
    y = 3.0 * x[:, 0] + 3.0 * x[:, 1] + rng.standard_normal(100)
    offers = [single(n, k) for k, n in enumerate(("one", "two", "sum"))]
    found = find_explanation(bank(y, x, offers, UNBOUND[:3]))
    assert {o.name for o in found.offers} == {"one", "two"}


def test_a_name_with_several_places_gives_way_to_several_names() -> None:
    """Each of its places imitates the sum of two others: if one place is shut, another comes."""
    rng = np.random.default_rng(5)
    true = rng.standard_normal((150, 2))
    seats = true.sum(axis=1, keepdims=True) + 0.3 * rng.standard_normal((150, 2))
    y = 3.0 * true.sum(axis=1) + rng.standard_normal(150)
    places = [Offer("seat", (f"seat {k}",), ((2 + k,),), math.log(0.05)) for k in range(2)]
    offers = [*places, single("one", 0), single("two", 1)]
    found = find_explanation(bank(y, np.column_stack([true, seats]), offers, UNBOUND[:4]))
    assert {o.name for o in found.offers} == {"one", "two"}


def test_three_names_are_found_behind_two_imitations() -> None:
    """One column imitates the sum of three, another that of two, which comes in its place."""
    rng = np.random.default_rng(1)
    true = rng.standard_normal((150, 3))
    known = true.sum(axis=1) + 0.3 * rng.standard_normal(150)
    other = true[:, 1] + true[:, 2] + 0.5 * rng.standard_normal(150)
    y = 3.0 * true.sum(axis=1) + rng.standard_normal(150)
    offers = [single(n, k) for k, n in enumerate("kabcd")]
    of = bank(y, np.column_stack([known, true, other]), offers, UNBOUND[:5])
    assert {o.name for o in find_explanation(of, known=[0]).offers} == {"a", "b", "c"}


def test_what_is_known_stays_where_it_is_better() -> None:
    """Seven effects of which an ascent from nothing finds three at once."""
    rng = np.random.default_rng(6)
    x = rng.standard_normal((200, 7))
    y = x @ np.full(7, 2.0) + rng.standard_normal(200)
    of = bank(y, x, [single(f"n{k}", k) for k in range(7)], np.full(7, np.inf))
    assert len(find_explanation(of).effects) == 3
    assert len(find_explanation(of, known=range(5)).effects) == 7


def test_the_best_explanation_is_that_of_all_subsets() -> None:
    """Two true columns of five that run together: against every subset."""
    rng = np.random.default_rng(3)
    x = rng.standard_normal((120, 5)) + rng.standard_normal((120, 1))
    y = 1.5 * x[:, 1] - 1.2 * x[:, 4] + rng.standard_normal(120)
    offers = [single(f"n{k}", k) for k in range(5)]
    of = bank(y, x, offers, UNBOUND[:5])
    best = max((s for n in range(4) for s in itertools.combinations(offers, n)), key=of.evidence)
    assert {o.name for o in find_explanation(of).offers} == {o.name for o in best} == {"n1", "n4"}


def test_columns_that_are_alike_share_the_probability(columns: np.ndarray) -> None:
    x = np.column_stack([columns[:, 0], columns[:, 0], columns[:, 1]])
    y = 2.0 * x[:, 0] + np.random.default_rng(2).standard_normal(80)
    found = find_explanation(
        bank(y, x, [single("a", 0), single("b", 1), single("c", 2)], UNBOUND[:3])
    )
    assert len(found.effects) == 1
    assert found.effects[0].probabilities[:2] == pytest.approx([0.5, 0.5], abs=0.01)
    assert found.effects[0].presence == pytest.approx(1.0, abs=1e-6)


def test_noise_is_none(columns: np.ndarray) -> None:
    y = np.random.default_rng(4).standard_normal(80)
    assert (
        find_explanation(
            bank(y, columns, [single(n, k) for k, n in enumerate("abc")], UNBOUND[:3])
        ).effects
        == ()
    )


def test_one_form_at_a_place(columns: np.ndarray) -> None:
    """What one effect holds is not on offer to another: a family goes without that place."""
    whole = Offer("a", ("one", "two", "three"), ((0,), (1,), (2,)), 0.0)
    left = whole.free_part(frozenset({"two"}))
    assert left is not None and left.keys == ("one", "three") and left.column_numbers == (0, 2)
    assert whole.free_part(frozenset({"one", "two"})) is None
    assert whole.free_part(frozenset({"four"})) is whole


def test_no_second_effect_takes_a_place_that_is_held(across: np.ndarray) -> None:
    """Two forms at one place, each of which explains a part; elsewhere both would be there."""
    y = across[:, :2] @ [2.0, 2.0]
    forms = [single("a", 0), single("b", 1)]
    here = [dataclasses.replace(form, keys=("joint 2",)) for form in forms]
    assert len(find_explanation(bank(y, across[:, :2], forms, UNBOUND[:2])).effects) == 2
    assert len(find_explanation(bank(y, across[:, :2], here, UNBOUND[:2])).effects) == 1


# ------------------------------------------------------------------ planted on the small arm


KINDS = (JointCompliance, JointGain, GearEccentricity, ServoDroop)


def explained(arm: Arm, seed: int, *planted: object) -> ExplainedSession:
    session = session_of(arm, seed, *planted)  # type: ignore[arg-type]
    base = Model(arm, (LinkDeflection(), *geometry_terms(arm, session)))
    offered = list_candidates(arm, session.context(), KINDS, base.terms)
    return explain_session(base, session, offered.testable, functions=False)


def test_a_planted_gain_is_found_at_its_joint_with_its_value(arm: Arm) -> None:
    found = explained(arm, 2, JointGain(5, gain=0.04))
    assert [(t.name, t.where) for t in found.chosen_terms] == [("joint_gain", "joint 5")]
    assert found.chosen_terms[0].gain == pytest.approx(0.04, rel=0.1)  # type: ignore[union-attr]
    assert found.found[0].presence > 0.999


def test_what_no_measurement_distinguishes_shares_its_probability(arm: Arm) -> None:
    found = explained(arm, 1, JointCompliance(2, compliance=8e-3)).found
    assert len(found) == 1
    chances = dict(found[0].names)
    assert chances["joint_compliance"] == pytest.approx(chances["servo_droop"], abs=0.05)
    assert set(found[0].credible) == {"joint_compliance", "servo_droop"}


def test_geometry_and_noise_name_nothing(arm: Arm) -> None:
    assert explained(arm, 3).found == ()


# ------------------------------------------------------------------ inputs of functions


def test_a_wave_is_bounded_by_its_phase_over_the_data() -> None:
    """45 um of sag along a beam is no input; of 30 mm, 200 periods a metre are a plain wave."""
    Cosine("distance_1_3", 0.40, 0.43, 2500.0).check()
    with pytest.raises(FunctionError, match="over the range of distance_1_3"):
        Cosine("distance_1_3", 0.0, 1.0, 2500.0).check()
