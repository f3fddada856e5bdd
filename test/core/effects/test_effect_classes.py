"""What the class of an effect must say, and that nothing else lists effects by name."""

from __future__ import annotations

import ast
import dataclasses
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from few_effects import names_alone
from hidden_arm import at, session
from places import ROOT
from small_arm import ARM

import longarm_comp
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.context import Context
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.effects import catalogue
from longarm_comp.core.effects.catalogue import BUILT_IN, LIBRARY, register, searched_effects
from longarm_comp.core.effects.drive_errors import GearEccentricity, JointGain
from longarm_comp.core.effects.effect import Effect, form, moving_joints, parameter, place
from longarm_comp.core.effects.slow_changes import change_so_far
from longarm_comp.core.errors import InputError
from longarm_comp.core.identify.diagnose import diagnose
from longarm_comp.sim.hidden import drives

EXAMPLE = ROOT / "examples" / "custom_effect.py"
GAIN = (drives.JointGain(at(2, 0.02)),)

pytestmark = pytest.mark.usefixtures("catalogue_of_ours")


# ------------------------------------------------------------------ what a class must say


@dataclasses.dataclass(frozen=True)
class Sound(JointGain):
    name: ClassVar[str] = "sound"


@dataclasses.dataclass(frozen=True)
class Undeclared(JointGain):
    name: ClassVar[str] = "undeclared"
    gate: float = 0.0


@dataclasses.dataclass(frozen=True)
class Shadowing(JointGain):
    name: ClassVar[str] = "shadowing"
    inputs: float = form(0.0)  # type: ignore[assignment]


@dataclasses.dataclass(frozen=True)
class Unstorable(JointGain):
    name: ClassVar[str] = "unstorable"
    sizes: tuple[int, ...] = form(0)


@dataclasses.dataclass(frozen=True)
class Unnamed(JointGain):
    name: ClassVar[str] = "Two Words"


class Plain(JointGain):
    name: ClassVar[str] = "plain"


def test_a_class_may_be_registered_by_a_program() -> None:
    assert register(Sound) is Sound
    assert searched_effects() == (*LIBRARY, Sound)
    assert catalogue.origin(Sound) == f"module {__name__}"


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Undeclared, r"undeclared\.gate.*place\(\), form\(\) or parameter\(\)"),
        (Shadowing, r"shadowing\.inputs: 'taken'"),
        (Unstorable, r"unstorable\.sizes.*int, float or str"),
        (Unnamed, "Two Words"),
        (Plain, "frozen dataclass"),
        (Effect, "nothing abstract"),
        (int, "a class of Effect or Bias"),
    ],
)
def test_a_class_that_cannot_be_one_is_refused(kind: Any, said: str) -> None:
    with pytest.raises(InputError, match=said):
        register(kind)
    assert set(catalogue.registered()) == set(BUILT_IN)


def test_a_scale_has_two_ends() -> None:
    with pytest.raises(TypeError, match="two ends"):
        form(0.0, lower=1.0)


@pytest.mark.parametrize("name", BUILT_IN)
def test_our_own_effects_say_all_that_others_must(name: str) -> None:
    kind = BUILT_IN[name]
    catalogue._check_kind(kind, name)
    assert {*kind.aliases, *kind.limit_aliases} <= set(BUILT_IN)
    for term in kind.for_arm(ARM):
        for field, allowed in kind.allowed_places().items():
            assert term.places[field] in allowed(ARM)


def test_the_library_is_what_its_classes_say() -> None:
    assert {"joint_zero", "dh_error", "link_deflection"} <= set(BUILT_IN)
    assert not any(k.geometry or k.name == "link_deflection" for k in LIBRARY)
    assert {n: dict(k.scales()) for n, k in BUILT_IN.items() if k.scales()} == {
        "backlash": {"gate": (0.0, 1.0), "blend": (0.01, 0.5)},
        "cylinder_play": {"gate": (0.0, 1.0), "blend": (0.01, 0.5)},
        "servo_deadband": {"gate": (0.0, 1.0), "blend": (0.01, 0.5)},
        "creep": {"time": (100.0, 1e5)},
        "camera_drift": {"slowing": (0.0, 36.0)},
        "base_settling": {"slowing": (0.0, 36.0)},
        "friction_hysteresis": {"near": (0.01, 0.6), "far": (0.01, 0.6)},
    }
    assert [n for n, k in BUILT_IN.items() if k.displaces_joint] == ["joint_zero"]
    assert GearEccentricity(2, order=2).forms == {"order": 2}


# ------------------------------------------------------------------ what the diagnosis asks a class


@dataclasses.dataclass(frozen=True)
class Twin(GearEccentricity):
    """Says that it cannot be told from the gain; the evidence alone would tell."""

    name: ClassVar[str] = "twin"
    aliases: ClassVar[tuple[str, ...]] = ("joint_gain",)
    free_levels: ClassVar[int] = 0


@dataclasses.dataclass(frozen=True)
class Stranger(Twin):
    name: ClassVar[str] = "stranger"
    aliases: ClassVar[tuple[str, ...]] = ()


@dataclasses.dataclass(frozen=True)
class GainOfTwin(JointGain):
    name: ClassVar[str] = "gain_of_twin"
    aliases: ClassVar[tuple[str, ...]] = ("stranger",)


@pytest.mark.parametrize(
    ("kinds", "names"),
    [
        pytest.param((JointGain, Stranger), {"joint_gain"}, marks=pytest.mark.long),
        ((JointGain, Twin), {"joint_gain", "twin"}),
        pytest.param((GainOfTwin, Stranger), {"gain_of_twin", "stranger"}, marks=pytest.mark.long),
    ],
)
def test_an_alias_is_what_one_of_two_classes_says(
    kinds: tuple[type[Effect], ...], names: set[str]
) -> None:
    far = [drives.JointGain(at(1, 0.1))]
    with names_alone():
        found = diagnose(ARM, session(far, n=90), test=session(far, n=40, seed=9), kinds=kinds)
    assert [set(f.names) for f in found.findings] == [names]


def test_a_place_may_be_anything_that_the_arm_has() -> None:
    def feet(arm: Arm) -> list[int]:
        return [1, 2, 3]

    @dataclasses.dataclass(frozen=True)
    class Foot(Effect):
        name: ClassVar[str] = "soft_foot"
        foot: int = place(feet)
        size: float = parameter("rad", "tilt", prior=1e-3)

        @classmethod
        def candidates(cls, arm: Arm) -> list[tuple[Foot, ...]]:
            return [(cls(foot=k),) for k in feet(arm)]

        def twists(self, posture: Any) -> dict[int, Any]:
            return {0: (0.0, 0.0, 0.0, self.size, 0.0, 0.0)}

    register(Foot)
    assert Foot.allowed_places() == {"foot": feet}
    assert moving_joints not in Foot.allowed_places().values()
    (first, *_, family) = list_candidates(ARM, session().context(), (Foot,)).testable
    assert (first.where, len(family.terms)) == (("foot 1",), 3)


# ------------------------------------------------------------------ no list of names elsewhere


ROOMS = ("identify", "model", "ik", "data", "compensation", "learn", "arm")


@pytest.mark.parametrize(
    "folder", [*(f"core/{room}" for room in ROOMS), "report", "nodes", "workflows", "cli"]
)
def test_no_effect_is_named_outside_its_own_file(folder: str) -> None:
    package = Path(longarm_comp.__file__).parent
    files = sorted((package / folder).rglob("*.py"))
    assert files
    for path in files:
        tree = ast.parse(path.read_text("utf-8"))
        named = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)} & set(BUILT_IN)
        assert not named, f"{path.name} names {named}"


@pytest.mark.parametrize("slowing", [5e-324, 1e-17, 1e-9])
def test_a_change_that_hardly_slows_goes_on_at_its_rate(slowing: float) -> None:
    clock = Context(columns={"t_s": np.array([0.0, 3600.0, 7200.0])})
    np.testing.assert_allclose(change_so_far(clock, slowing), [0.0, 1.0, 2.0], rtol=1e-8)
