"""Effects without a name as data: every engine, model files, domain, what is refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from every_circumstance import ENGINES, circumstances
from small_arm import ARM as SMALL

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.compensation.beyond import outside_data
from longarm_comp.core.compensation.compensate import compensate
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.compensation.result import Method, Status
from longarm_comp.core.effects.compliances import BearingTilt
from longarm_comp.core.effects.discovered import Discovered, DiscoveredView
from longarm_comp.core.effects.discovered_words import reading
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.effects.shapes import SHAPES
from longarm_comp.core.errors import InputError
from longarm_comp.core.ik.solver import Engine, solve_many
from longarm_comp.core.model.model import Model, unstack
from longarm_comp.core.model.model_file import load_model, save_model, store, undo

PULL = Discovered(
    "joint 5", "force y", "linear(q2) * linear(q5)", "q2 0.0..0.5; q5 -0.7..0.0", 20.0, 24.0
)
TERMS = (
    PULL,
    Discovered("joint 3", "turn z", "legendre(load_2, 3.0)", "load_2 -5.0..5.0", 1e-3, 2e-3),
    Discovered(
        "frame 3", "turn y", "switch(moment_3_x, 0.1, 0.05) * linear(side_2)",
        "moment_3_x -3.0..2.0; side_2 -1.0..1.0", 1e-3, 2e-3,
    ),
    Discovered("tip", "moment x", "above(sum_loads, 1.0)", "sum_loads -3.0..20.0", 1e-2, 0.2),
    Discovered(
        "tip", "force z", "cos(q1, 2.0) * square(distance_1_5)",
        "q1 -1.0..1.0; distance_1_5 0.1..1.0", 0.1, 0.2,
    ),
    Discovered(
        "base", "turn x", "sin(probe, 6.0) * linear(warmth)",
        "probe -1.0..1.0; warmth -10.0..20.0", 1e-4, 1e-4,
    ),
    Discovered(
        "base", "move x", "signed_square(gravity_4_x) * below(q4, 0.3)",
        "gravity_4_x -1.0..1.0; q4 0.0..1.0", 1e-3, 1e-2,
    ),
)  # fmt: skip
VIEW = DiscoveredView(
    "y", "linear(seen_x) * linear(t_s)", "seen_x -1.0..2.0; t_s 0.0..7200.0", 1e-7, 1e-6
)


@pytest.fixture(scope="module")
def model(demo: Arm) -> Model:
    """Every shape, all kinds of component and quantity."""
    made = Model(demo, (LinkDeflection(), *TERMS), (VIEW,))
    words = {f.word for t in TERMS for f in t.of.factors}
    assert words == set(SHAPES)
    return made


@pytest.mark.parametrize("engine", ENGINES)
def test_every_engine_reaches_the_model(model: Model, engine: Engine) -> None:
    q, context = circumstances(model.arm)
    target = model.tip(q, context)
    assert np.abs(target - Model(model.arm, (LinkDeflection(),)).tip(q, context)).max() > 1e-3
    seed = np.clip(q + 0.02, model.arm.lower, model.arm.upper)
    found = solve_many(model, target, seed=seed, context=context, engine=engine)
    assert found.ok.all()
    np.testing.assert_allclose(model.tip(found.q, context), target, rtol=0, atol=1e-8)


def test_one_posture_is_a_row_of_many(model: Model) -> None:
    q, context = circumstances(model.arm)
    single = [model.measured(row, context.take(k)) for k, row in enumerate(q)]
    np.testing.assert_allclose(model.measured(q, context), single, rtol=0, atol=1e-13)


def test_a_force_bends_the_beams_like_a_weight_there(demo: Arm) -> None:
    """A constant force down at the tip is what a further payload of that weight is, sag apart."""
    from longarm_comp.core.effects.masses import TipPayload

    q = demo.mid[None] + 0.0
    sagging = Model(demo, (LinkDeflection(),))
    posture = sagging.posture(unstack(q))
    down = posture.gravity_in(posture.frame(demo.tip.frame))
    mass = 0.01
    heavier = sagging.plus(TipPayload(mass=mass)).tip(q) - sagging.tip(q)
    pushed = sagging.plus(
        *(
            Discovered("tip", f"force {axis}", amount=float(mass * g[0]))
            for axis, g in zip("xyz", down, strict=True)
        )
    ).tip(q)
    weight = Discovered("tip", "weight", amount=mass * float(np.linalg.norm(down)))
    for moved in (pushed, sagging.plus(weight).tip(q)):
        np.testing.assert_allclose(moved - sagging.tip(q), heavier, rtol=0, atol=0.05 * 1e-4)
    assert np.linalg.norm(heavier) > 1e-4
    assert reading([weight]) == "behaves like a mass that is not declared"


def test_what_gives_alike_about_all_axes_is_a_bearing_that_tilts(demo: Arm) -> None:
    sagging, q = Model(demo, (LinkDeflection(),)), demo.mid[None] + [[0.1], [-0.1]]
    give = Discovered("joint 2", "give", amount=6e-3)
    soft, tilting = (
        sagging.plus(term).tip(q) - sagging.tip(q)
        for term in (give, BearingTilt(2, about_x=6e-3, about_y=6e-3))
    )
    np.testing.assert_allclose(soft, tilting, rtol=0, atol=1e-6)
    assert np.abs(tilting).max() > 1e-3
    assert reading([give]) == "behaves like a soft part that yields under load"


# ------------------------------------------------------------------ in model.yaml


def test_round_trip_and_undo(model: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    save_model(path, store(Model(model.arm, (LinkDeflection(),))))
    first = path.read_bytes()
    save_model(path, store(model))
    back = load_model(path, model.arm)
    assert set(back.effects) == set(model.effects)
    assert back.biases == model.biases
    stored = yaml.safe_load(path.read_text())
    held = next(e for e in stored["effects"] if e["form"].get("at") == "joint 5")
    assert held["parameters"]["amount"] == {"value": 24.0, "unit": "N/rad^2", "ci95": None}
    undo(path)
    assert path.read_bytes() == first


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("at", "joint 9", "discovered.at: 'joint 9'"),
        ("component", "force w", "discovered.component: 'force w'"),
        ("function", "q2 * q5", r"shapes: linear, square"),
        ("function", "linear(q2) * linear(q5) * linear(q2) * linear(q5)", "at most 3"),
        ("function", "__import__(q2)", "a shape of a quantity"),
        ("function", "linear(q2)", "quantities of the function only"),
        ("function", "linear(q2) * linear(q6)", "domain without q6"),
        ("function", "legendre(q2, 9.0) * linear(q5)", "order 9"),
        ("function", "legendre(q2, 1.5) * linear(q5)", "order 1.5"),
        ("function", "switch(q2, 0.1, 0.0) * linear(q5)", "half 0.0"),
        ("function", "switch(q2, 0.1) * linear(q5)", r"switch\(quantity, threshold, half\)"),
        ("function", "above(q2, 1e999) * linear(q5)", "threshold inf"),
        ("function", "above(q2, nan) * linear(q5)", "a number"),
        ("domain", "q2 0.5..0.0; q5 -0.7..0.0", "lower < upper"),
        ("domain", "q2 0.0..0.5; q5 -1e12..0.0", "within"),
        ("domain", "q2 0.0..0.5; q2 0.0..0.4; q5 -0.7..0.0", "each quantity once"),
        ("domain", "q2; q5", "a quantity and its range"),
        ("scale", 0.0, "scale: 0.0; allowed: above 0"),
        ("scale", float("inf"), "scale"),
        ("function", 3, "discovered.function: 3; allowed: text"),
    ],
)  # fmt: skip
def test_what_means_nothing_is_refused(
    demo: Arm, tmp_path: Path, field: str, value: object, said: str
) -> None:
    path = tmp_path / "model.yaml"
    save_model(path, store(Model(demo, (PULL,))))
    stored = yaml.safe_load(path.read_text())
    stored["effects"][0]["form"][field] = value
    path.write_text(yaml.safe_dump(stored))
    with pytest.raises(InputError, match=said):
        load_model(path, demo)


@pytest.mark.parametrize("name", ["q8", "load_0", "moment_9_x", "distance_5_2", "seen_x"])
def test_a_quantity_that_the_arm_has_not_is_refused(demo: Arm, tmp_path: Path, name: str) -> None:
    path = tmp_path / "model.yaml"
    term = Discovered("base", "move x", f"linear({name})", f"{name} 0.0..1.0")
    stored = store(Model(demo, (PULL,))).model_dump(mode="json", by_alias=True)
    stored["effects"][0]["form"] |= {"function": term.function, "domain": term.domain}
    path.write_text(yaml.safe_dump(stored))
    with pytest.raises(InputError, match=f"'{name}'; allowed: a quantity of this arm"):
        load_model(path, demo)


# ------------------------------------------------------------------ where it holds


def test_outside_its_data_it_stands_still_and_the_command_says_so() -> None:
    turned = Discovered("joint 2", "turn z", "square(q2)", "q2 0.3..0.6", 1e-2, 0.05)
    model = Model(SMALL, (turned,))
    q = np.array([[0.1, 0.6, 0.05, 0.2], [0.1, 0.9, 0.05, 0.2]])
    shift = [np.linalg.norm(p) for p in model.tip(q) - Model(SMALL).tip(q)]
    turn = 0.05 * 0.6**2
    moved = q.copy()
    moved[:, 1] += turn
    np.testing.assert_allclose(model.tip(q), Model(SMALL).tip(moved), atol=1e-9)
    assert shift[0] > 1e-3
    for row, said in zip(q, (False, True), strict=True):
        found = compensate(model, None, model.tip(row), seed=row, method=Method.DEFLECTION)[0]
        assert found.status is Status.SUCCESS
        assert ("outside the data from which an effect was found: q2 0.9" in found.reason) == said
    sd, said = outside_data(model, q, Context())
    assert [bool(each) for each in said] == [False, True] and not sd[0].any()


@pytest.mark.parametrize("q2", [0.9, 0.2])
def test_outside_its_data_a_function_may_go_on_and_the_promise_knows_it(q2: float) -> None:
    """A straight line that goes on is as far off as one standard deviation."""
    turned = Discovered("joint 2", "turn z", "linear(q2) * linear(q4)", "q2 0.3..0.6; q4 0.0..1.0")
    stands = Model(SMALL, (dataclasses.replace(turned, amount=-0.05),))
    goes_on = dataclasses.replace(turned, amount=-0.05, domain="q2 -1.0..1.0; q4 -1.0..1.0")
    q = np.array([[0.1, q2, 0.05, 0.7]])
    off = stands.tip(q) - Model(SMALL, (goes_on,)).tip(q)
    sd, _ = outside_data(stands, q, Context())
    np.testing.assert_allclose(sd, abs(off), rtol=0.05, atol=1e-6)
    assert np.linalg.norm(off) > 1e-3
    (found,) = compensate(stands, None, stands.tip(q[0]), seed=q[0], method=Method.DEFLECTION)
    known = expected_miss(stands, q, Context(), stands.tip(q)).sigma[0]
    np.testing.assert_allclose(found.sigma, np.hypot(known, sd[0]), rtol=1e-3)


def test_a_command_without_the_column_that_drives_it_is_stale() -> None:
    driven = Discovered("base", "move x", "sin(pump_bar, 6.0)", "pump_bar 0.0..3.0", 1e-3, 2e-3)
    found = compensate(Model(SMALL, (driven,)), None, SMALL_TIP, method=Method.DEFLECTION)[0]
    assert found.status is Status.STALE_CONTEXT
    assert "pump_bar" in found.reason


SMALL_TIP = Model(SMALL).tip(SMALL.mid)
