"""What an effect says of itself to a mechanic: title, action, reading; values in people's units."""

import math

import pytest

from longarm_comp.core.effects.catalogue import BUILT_IN
from longarm_comp.core.effects.drive_errors import ServoQuantisation
from longarm_comp.core.effects.units import for_people


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_effect_has_a_title_and_an_action_of_its_own(name: str) -> None:
    kind = BUILT_IN[name]
    for field in ("title", "action"):
        assert field in vars(kind), f"{name} declares no {field} in its own file"
    assert kind.title == kind.heading() and "_" not in kind.title
    assert kind.action[0].isupper() and kind.action.endswith(".") and len(kind.action) > 15
    assert name not in kind.action


def test_titles_tell_effects_apart() -> None:
    titles = [kind.title for kind in BUILT_IN.values()]
    assert len(set(titles)) == len(titles)


def test_an_effect_without_parameters_says_what_it_is() -> None:
    assert (
        ServoQuantisation(joint=2, steps_per_turn=1000).reading == "1000 steps a turn, 0.36° each"
    )
    assert "declares" in ServoQuantisation(joint=2, steps_per_turn=0).reading


@pytest.mark.parametrize(
    ("unit", "factor", "shown"),
    [
        ("rad", math.degrees(1), "°"),
        ("rad/(N m)", math.degrees(1), "°/(N m)"),
        ("m", 1e3, "mm"),
        ("m/h", 1e3, "mm/h"),
        ("1", 100.0, "%"),
        ("1/K", 1.0, "1/K"),
        ("kg", 1.0, "kg"),
    ],
)
def test_units_that_people_read(unit: str, factor: float, shown: str) -> None:
    assert for_people(unit) == (factor, shown)
