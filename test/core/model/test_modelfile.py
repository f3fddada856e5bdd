"""`model.yaml`: what is written comes back to the last bit; what is wrong is one clear line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from small_arm import ARM as SMALL
from unprivileged import unprivileged

from longarm_comp.core import files
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.effects.catalogue import BUILT_IN
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.geometry_errors import DhError, JointZero
from longarm_comp.core.effects.typical_loads import reach
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import (
    load_model,
    previous,
    read_stored,
    save_model,
    store,
    undo,
)
from longarm_comp.workflows.inputs import choose_physics


@pytest.fixture
def simple(arm: Arm) -> Model:
    return Model(arm, (JointZero(1, offset=0.01), JointCompliance(2, compliance=1e-3)))


def everything(arm: Arm, rng: np.random.Generator) -> Model:
    """Every effect of the catalogue at every place, with values that no decimal writes shortly."""
    terms = []
    for kind in BUILT_IN.values():
        for term in kind.for_arm(arm):
            size = {p.name: p.prior * abs(rng.standard_normal()) for p in term.parameters(arm)}
            terms.append(term.with_values(size))
    effects = tuple(t for t in terms if isinstance(t, Effect))
    biases = tuple(t for t in terms if not isinstance(t, Effect))
    arrivals = tuple((k, 2 * k) for k in range(arm.n))
    more = {"passes": 4, "elements_per_beam": 3, "arrivals": arrivals}
    return Model(arm, effects, biases, row_legs=tuple(rng.random(arm.n)), **more)


def test_round_trip_to_the_last_bit(arm: Arm, tmp_path: Path, rng: np.random.Generator) -> None:
    model = everything(arm, rng)
    save_model(tmp_path / "model.yaml", store(model, provenance={"seed": 3}))
    back = load_model(tmp_path / "model.yaml", arm)
    assert set(back.effects) == set(model.effects)  # files sort geometry before effects
    assert back.biases == model.biases
    assert (back.arrivals, back.row_legs) == (model.arrivals, model.row_legs)
    assert (back.passes, back.elements_per_beam) == (4, 3)
    save_model(tmp_path / "again.yaml", store(back, provenance={"seed": 3}))
    assert (tmp_path / "again.yaml").read_bytes() == (tmp_path / "model.yaml").read_bytes()


def test_intervals_are_normal_within_the_bounds(simple: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    errors = np.array([0.001, 0.002])
    save_model(path, store(simple, errors, version=7, origins={1: "diagnosis"}))
    stored = read_stored(path)
    zero, soft = stored.geometry[0], stored.effects[0]
    assert zero.parameters["offset"].ci95 == pytest.approx((0.01 - 0.00196, 0.01 + 0.00196))
    assert soft.parameters["compliance"].ci95 == pytest.approx((0.0, 0.001 + 0.00392))
    assert (stored.version, soft.origin, zero.parameters["offset"].unit) == (7, "diagnosis", "rad")
    boot = {(1, "compliance"): (5e-4, 2e-3)}
    assert store(simple, errors, intervals=boot).effects[0].parameters["compliance"].ci95 == (
        5e-4,
        2e-3,
    )


def test_undo_is_byte_for_byte(simple: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    save_model(path, store(simple))
    path.write_text(path.read_text() + "# a note by hand, ÄÖ\n", encoding="utf-8")
    before = path.read_bytes()
    save_model(path, store(simple, version=2))
    assert path.read_bytes() != before
    undo(path)
    assert path.read_bytes() == before
    with pytest.raises(InputError, match="previous version"):
        undo(path)


def test_undo_keeps_line_ends(simple: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    save_model(path, store(simple))
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    before = path.read_bytes()
    save_model(path, store(simple, version=2))
    undo(path)
    assert path.read_bytes() == before


def test_interrupted_write_leaves_the_old_model(
    simple: Model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "model.yaml"
    save_model(path, store(simple))
    before = path.read_bytes()

    def pulled(descriptor: int) -> None:
        raise OSError("power cut")

    monkeypatch.setattr(files.os, "fsync", pulled)
    with pytest.raises(OSError, match="power cut"):
        save_model(path, store(simple, version=2))
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert load_model(path, simple.arm) == simple
    assert [p.name for p in tmp_path.iterdir()] == ["model.yaml"]


def test_a_model_belongs_to_one_arm(simple: Model, tmp_path: Path) -> None:
    save_model(tmp_path / "model.yaml", store(simple))
    with pytest.raises(InputError, match=r"arm\.hash.*calibrate again") as caught:
        load_model(tmp_path / "model.yaml", SMALL)
    assert "long_arm_demo" in str(caught.value) and "small" in str(caught.value)
    data = simple.arm.model_dump(mode="json", exclude_defaults=True)
    edited = Arm.parse({**data, "reference_temperature_c": 25.0}, "edited")
    assert edited.name == simple.arm.name
    with pytest.raises(InputError, match=r"arm\.hash.*calibrate again"):
        load_model(tmp_path / "model.yaml", edited)
    with pytest.raises(InputError, match="a model of long_arm_demo"):
        choose_physics(edited, simple)


def change(*path: str | int, to: Any) -> Callable[[dict[str, Any]], None]:
    def edit(data: dict[str, Any]) -> None:
        node: Any = data
        for part in path[:-1]:
            node = node[part]
        node[path[-1]] = to

    return edit


EFFECT = ("effects", 0)
VALUE = (*EFFECT, "parameters", "compliance", "value")
FAULTS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "unknown effect": (change(*EFFECT, "effect", to="joint_complience"), "joint_complience"),
    "unknown joint": (change(*EFFECT, "form", "joint", to=9), "joint_compliance.joint: 9"),
    "joint in words": (change(*EFFECT, "form", "joint", to="two"), "joint_compliance.joint: 'two'"),
    "unknown beam": (
        change("effects", to=[{"effect": "link_stiffness", "where": "", "form": {"beam": "leg"}}]),
        "link_stiffness.beam: 'leg'",
    ),
    "unknown marker": (
        change("geometry", to=[{"effect": "tip_offset", "where": "", "form": {"marker": "top"}}]),
        "tip_offset.marker: 'top'",
    ),
    "no place": (change(*EFFECT, "form", to={}), "joint_compliance"),
    "unknown form": (change(*EFFECT, "form", "gate", to=0.1), "joint_compliance.gate"),
    "unknown parameter": (
        change(*EFFECT, "parameters", "softness", to={"value": 1.0, "unit": "1"}),
        "joint_compliance.softness",
    ),
    "unknown key": (change(*EFFECT, "wher", to="joint 2"), "effects.0.wher"),
    "missing unit": (change(*EFFECT, "parameters", "compliance", to={"value": 1e-3}), "unit"),
    "another unit": (
        change(*EFFECT, "parameters", "compliance", "unit", to="deg/(N m)"),
        "'deg/(N m)'; allowed: rad/(N m)",
    ),
    "not a number": (change(*VALUE, to=float("nan")), "compliance.value: nan"),
    "infinite": (change(*VALUE, to=float("inf")), "compliance.value: inf"),
    "text": (change(*VALUE, to="soft"), "'soft'"),
    "negative compliance": (change(*VALUE, to=-1e-6), "joint_compliance.compliance: -1e-06"),
    "another format": (change("schema", to="longarm/model/9"), "schema: 'longarm/model/9'"),
    "no format": (lambda d: d.pop("schema"), "schema: 'missing'"),
    "no passes": (change("passes", to=0), "passes: 0"),
    "no elements": (change("elements_per_beam", to=0), "elements_per_beam: 0"),
    "effects is no list": (change("effects", to={"a": 1}), "effects"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_one_line(simple: Model, tmp_path: Path, name: str) -> None:
    path = tmp_path / "model.yaml"
    save_model(path, store(simple))
    data = yaml.safe_load(path.read_text())
    edit, said = FAULTS[name]
    edit(data)
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError) as caught:
        load_model(path, simple.arm)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert said in text
    assert "\n" not in text


@pytest.mark.parametrize("name", ["a", "b", "d"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_length_is_wrong_by_a_quarter_of_the_reach_at_most(
    arm: Arm, tmp_path: Path, name: str, sign: float
) -> None:
    """The URDF of an arm with a link of -1 m would be written, and commands be computed with it."""
    for share in (0.24, 0.26):
        error = DhError(row=3).with_values({name: sign * share * reach(arm)})
        save_model(tmp_path / "model.yaml", store(Model(arm, (error,))))
        if share < 0.25:
            assert load_model(tmp_path / "model.yaml", arm).effects == (error,)
        else:
            with pytest.raises(InputError, match=f"dh_error.{name} at row 3.*a quarter of the arm"):
                load_model(tmp_path / "model.yaml", arm)


def test_truncated_anywhere_is_an_input_error(simple: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    save_model(path, store(simple, provenance={"seed": 1}))
    whole = path.read_bytes()
    for end in range(0, whole.rindex(b"provenance:"), 17):
        path.write_bytes(whole[:end])
        with pytest.raises(InputError):
            load_model(path, simple.arm)


def test_read_only_folder(simple: Model, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with unprivileged(), pytest.raises(InputError, match="output folder"):
        save_model(tmp_path / "model.yaml", store(simple))
    tmp_path.chmod(0o700)


def test_the_version_before_is_a_model_too(simple: Model, tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    save_model(path, store(simple))
    save_model(path, store(simple.with_values(simple.values * 2), version=2))
    assert load_model(previous(path), simple.arm) == simple
    assert read_stored(path).version == 2
