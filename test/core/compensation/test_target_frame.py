"""The frame of targets: the arm's base or that of the measurements, said or refused."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell
from small_arm import ARM, AWAY, measured

import longarm_comp as la
from longarm_comp.core.arm.context import Context
from longarm_comp.core.arm.frame_tree import carry_place
from longarm_comp.core.arm.parts import Payload
from longarm_comp.core.arm.quaternion import from_rotation
from longarm_comp.core.compensation.expected import expected_miss
from longarm_comp.core.compensation.target_frame import base_of_graph, find_placement
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.compliances import JointCompliance
from longarm_comp.core.effects.geometry_errors import DhError, JointZero
from longarm_comp.core.effects.placements import BasePose
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import save_model, store
from longarm_comp.core.model.uncertainty import ModelUncertainty
from longarm_comp.sessions.csv import write_csv
from longarm_comp.sessions.targets import Targets

NEAR = BasePose(x=0.004, rz=0.005)


def moved(base: BasePose, point: np.ndarray) -> np.ndarray:
    """A point of the declared base where this base stands."""
    matrix = base.base(ARM).matrix() @ np.linalg.inv(ARM.base.frame().matrix())
    return matrix[:3, :3] @ point + matrix[:3, 3]


def test_each_frame_brings_the_tip_where_it_says() -> None:
    model = Model(ARM, (AWAY,))
    target = Model(ARM).tip(ARM.mid)
    (base,) = la.compensate(model, target, frame="base")
    np.testing.assert_allclose(base.command, ARM.mid, atol=1e-6)
    np.testing.assert_allclose(model.tip(base.command), moved(AWAY, target), atol=1e-8)
    (seen,) = la.compensate(model, moved(AWAY, target), frame="measured")
    np.testing.assert_allclose(seen.command, ARM.mid, atol=1e-6)
    pose = Model(ARM).pose(ARM.mid)
    (turned,) = la.compensate(model, pose, frame="base", seed=ARM.mid + 0.02)
    np.testing.assert_allclose(model.pose(turned.command)[:3, :3], turned.target[:3, :3], atol=1e-6)


@pytest.mark.parametrize("seed", [1, 3])
def test_a_promise_counts_what_nobody_knows_of_the_targets_frame(seed: int) -> None:
    """Rows of a tracker tell where it saw the tip, and hardly the zero of the first joint."""
    draw = np.random.default_rng(seed)
    true = [
        effect.with_values({p.name: draw.normal(0.0, p.width) for p in effect.parameters(ARM)})
        for effect in (*JointZero.for_arm(ARM), *DhError.for_arm(ARM))
    ]
    arm, far = Model(ARM, tuple(true)), Model(ARM, (*true, AWAY))
    q = draw.uniform(ARM.lower, ARM.upper, (200, ARM.n))
    rows = Session.record(q, far.tip(q) + 5e-5 * draw.standard_normal((200, 3)))
    model = la.calibrate(ARM, rows).model
    fresh = draw.uniform(ARM.lower, ARM.upper, (20, ARM.n))
    for frame, real, least, most in (("base", arm, 1.0, 10.0), ("measured", far, 0.01, 0.1)):
        made = la.compensate(model, real.tip(fresh), frame=frame)
        missed = np.linalg.norm(real.tip(made.command) - real.tip(fresh), axis=1)
        promised = np.array([one.p90_m for one in made])
        assert (missed <= promised).mean() >= 0.8
        assert least < 1e3 * promised.mean() < most


def test_targets_of_both_kinds_are_each_by_itself(rng: np.random.Generator) -> None:
    """Positions and poses in turn, each with its own payload, and one of the arm's own frame."""
    carries = ARM.model_copy(update={"payload": Payload(mass_kg=0.3, frame=4)})
    model = Model(carries, (AWAY, JointCompliance(1, 2e-3)))
    q = ARM.mid + 0.2 * (ARM.upper - ARM.mid) * rng.uniform(-1.0, 1.0, (8, ARM.n))
    kg = np.linspace(0.0, 3.0, 8)
    poses = model.pose(q, Context(columns={"payload_kg": kg}))
    turns = np.array([from_rotation(pose[:3, :3]) for pose in poses])
    turns[::2] = np.nan
    frames = ("measured",) * 7 + ("base",)
    given = Targets(
        np.arange(8), poses[:, :3, 3], turns, np.zeros(8), {"payload_kg": kg}, frame=frames
    )
    many = la.compensate(model, given, seed=q)
    np.testing.assert_allclose(many.command[:-1], q[:-1], atol=1e-7)
    for k, each in enumerate(many):
        target = poses[k] if k % 2 else poses[k, :3, 3]
        context = Context(columns={"payload_kg": kg[k]})
        one = la.compensate(model, target, frame=frames[k], context=context, seed=q[k])[0]
        np.testing.assert_allclose(each.command, one.command, atol=1e-8)
        assert (each.status, each.reason) == (one.status, one.reason)
        assert each.expected_m == pytest.approx(one.expected_m, nan_ok=True)


def test_where_it_matters_and_nobody_said_it_both_are_offered() -> None:
    target = Model(ARM).tip(ARM.mid)
    with pytest.raises(la.InputError, match=r"base .* or measured"):
        la.compensate(Model(ARM, (AWAY,)), target)
    made = la.compensate(Model(ARM, (NEAR,)), target)
    assert made.success.all() and "frame measured" in made.frames[0]
    assert "frame base" in la.compensate(Model(ARM), target).frames[0]
    pivot = BasePose(x=0.8 * target[1], y=-0.8 * target[0], rz=0.8)  # a turn about the target
    np.testing.assert_allclose(moved(pivot, target), target, atol=1e-12)
    with pytest.raises(la.InputError, match=r"base .* or measured"):
        la.compensate(Model(ARM, (pivot,)), target)


def test_the_base_of_a_graph_is_the_arms_own_wherever_the_tracker_stands() -> None:
    target, pose = Model(ARM).tip(ARM.mid), Model(ARM).pose(ARM.mid)
    far = base_of_graph(Model(ARM, (AWAY,)))
    assert far.solved and far.frame == "base"
    np.testing.assert_allclose(far.carry_to_model(target), moved(AWAY, target), atol=1e-12)
    np.testing.assert_allclose(far.carry_from_model(far.carry_to_model(pose)), pose, atol=1e-12)
    three = far.carry_to_model(np.array([target] * 3))
    np.testing.assert_allclose(far.carry_from_model(three), [target] * 3)
    for model, solved in ((Model(ARM), False), (Model(ARM, (NEAR,)), True)):
        here = base_of_graph(model)  # as files have it, where nobody said the frame
        assert here.solved is solved and here.frame == "measured"
        np.testing.assert_array_equal(here.motion, np.eye(4))
    grouped = base_of_graph(Model(ARM, (BasePose(group="a", x=8.0),)))
    assert not grouped.solved and grouped.frame == "measured"


@pytest.mark.parametrize("base", [AWAY, NEAR])
def test_a_graph_and_files_carry_what_was_measured_alike(base: BasePose) -> None:
    """The camera had moved all rows by some millimetres."""
    model = dataclasses.replace(Model(ARM, (base,)), frame_shift=(3e-3, -2e-3, 1e-3))
    point = moved(base, Model(ARM).tip(ARM.mid))
    graph = base_of_graph(model)
    in_base = carry_place(graph.measurements, point)
    files = find_placement(model, "measured").carry_to_model(point)
    np.testing.assert_allclose(graph.carry_to_model(in_base), files, atol=1e-12)
    np.testing.assert_allclose(files, point - model.frame_shift, atol=1e-12)


def test_a_path_is_corrected_by_what_the_arm_does_and_not_by_where_the_tracker_stands() -> None:
    path = Model(ARM).tip(ARM.mid + np.outer([0.0, 0.05, 0.1], ARM.upper - ARM.mid))
    models = [Model(ARM, (JointZero(2, 2e-3), *base)) for base in ((AWAY,), ())]
    away, home = (la.compensate_path(m, path, frame="base", seed=ARM.mid) for m in models)
    np.testing.assert_allclose(away.correction_m, home.correction_m, atol=1e-6)
    assert 1e-4 < away.correction_m.max() < 2e-3


def test_the_frame_of_the_measurements_needs_a_calibration() -> None:
    target = Model(ARM).tip(ARM.mid)
    with pytest.raises(la.InputError, match="calibrated model"):
        la.compensate(Model(ARM), target, frame="measured")
    known = {"base": {"xyz_m": 0.001, "rpy_deg": 0.1}}
    told = la.Arm.parse({**ARM.model_dump(exclude_defaults=True), "tolerance": known}, "arm")
    assert la.compensate(Model(told), target, frame="measured").success.all()
    with pytest.raises(la.InputError, match="base or measured"):
        la.compensate(Model(ARM), target, frame="world")


def test_a_base_that_was_moved_is_named_by_its_group() -> None:
    bases = (BasePose(group="a", x=1.0), BasePose(group="b", x=-1.0))
    model, target = Model(ARM, bases), Model(ARM).tip(ARM.mid)
    for frame in ("base", "measured"):
        with pytest.raises(la.InputError, match="group"):
            la.compensate(model, target, frame=frame)
    for name, x in (("a", 1.0), ("b", -1.0)):
        found = find_placement(model, "base", name)
        np.testing.assert_allclose(
            found.carry_to_model(target), target + np.array([x, 0, 0]), atol=1e-9
        )
        context = Context(labels={"group": np.array([name])})
        assert la.compensate(model, target, frame="base", context=context).success.all()


@pytest.fixture
def tracked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An arm, and a model whose base a tracker saw far away."""
    monkeypatch.chdir(tmp_path)
    Path("arm.yaml").write_text(ARM.model_dump_json(exclude_defaults=True))
    save_model("model.yaml", store(Model(ARM, (AWAY,))))
    return tmp_path


def written(lines: list[str], name: str = "t.csv") -> str:
    Path(name).write_text("\n".join(lines) + "\n")
    return name


def test_a_file_of_targets_says_its_frame(
    tracked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shell = Shell(tracked, capsys)
    x, y, z = Model(ARM).tip(ARM.mid)
    u, v, w = moved(AWAY, np.array([x, y, z]))
    words = ("compensate", "arm.yaml", "--model", "model.yaml", "--targets")
    plain = written(["x,y,z", f"{x},{y},{z}"])
    line = shell.refused(*words, plain)
    assert "base" in line and "measured" in line and "--frame" in line
    assert shell(*words, plain, "--frame", "base") == 0
    at = ", ".join(f"{value:.4f}" for value in AWAY.base(ARM).p)
    assert "frame base" in shell.err and f"stands at {at} m" in shell.err
    both = written(["x,y,z,frame", f"{x},{y},{z},base", f"{u},{v},{w},measured"], "both.csv")
    made = shell.json(*words, both)
    assert [c["frame"] for c in made["commands"]] == ["base", "measured"]
    assert len(made["frames"]) == 2
    joints = [[c[f"q{j}"] for j in range(1, 5)] for c in made["commands"]]
    np.testing.assert_allclose(joints[0], joints[1], atol=1e-6)
    with open("commands.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    shown = [[float(row[f"target_{axis}"]) for axis in "xyz"] for row in rows]
    np.testing.assert_allclose(shown, [[x, y, z], [u, v, w]], atol=1e-9)
    assert "frame" in shell.refused(*words, both, "--frame", "base")
    odd = written(["x,y,z,frame", f"{x},{y},{z},tool"], "odd.csv")
    assert "base or measured" in shell.refused(*words, odd)


def test_a_calibration_by_a_tracker_makes_the_frame_matter(
    tracked: Path, capsys: pytest.CaptureFixture[str], rng: np.random.Generator
) -> None:
    """From rows to the refusal, with the files that a user has."""
    shell = Shell(tracked, capsys)
    rows = measured(60, rng)
    far = np.array([moved(AWAY, point) for point in rows.xyz])
    write_csv(la.Session.record(rows.q, far), "samples.csv")
    assert shell("calibrate", "arm.yaml", "samples.csv", "-o", "made.yaml") == 0
    x, y, z = Model(ARM).tip(ARM.mid)
    words = ("compensate", "arm.yaml", x, y, z, "--model", "made.yaml")
    assert "measured" in shell.refused(*words)
    (command,) = shell.json(*words, "--frame", "base")["commands"]
    assert 1.0 < command["expected_mm"] < 5.0  # nothing tells the base from the joints' zeros
    q = [command[f"q{j}"] for j in range(1, 5)]
    assert np.linalg.norm(Model(ARM).tip(np.array(q)) - [x, y, z]) < 5e-4


def test_millimetres_are_guessed(tracked: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shell = Shell(tracked, capsys)
    tip = Model(ARM).tip(ARM.mid)
    for factor, unit in ((1e3, "millimetres"), (1e2, "centimetres"), (1e6, "metres")):
        x, y, z = factor * tip
        assert f"are these {unit}?" in shell.refused("compensate", "arm.yaml", x, y, z, code=3)
    x, y, z = 2.5 * tip
    assert "are these" not in shell.refused("compensate", "arm.yaml", x, y, z, code=3)


def test_a_learned_error_does_not_tell_where_the_frame_of_targets_lies() -> None:
    frame = np.diag([9e-6, 0.0, 0.0])
    small = 1e-8 * np.eye(3)
    plain = Model(ARM, (JointZero(1),))
    names = tuple(s.identity for s in plain.slots)
    known = ModelUncertainty(names, 1e-6 * np.eye(1), small, small, 1e-3, 100, frame=frame)
    model = dataclasses.replace(plain, uncertainty=known)
    tip = model.tip(ARM.mid)
    for learned in (None, np.full(3, 2e-4)):
        miss = expected_miss(model, ARM.mid, Context(), tip, learned)
        assert miss.sigma[0] > 3e-3 > 1e-3 > miss.sigma[1]
