"""``import longarm_comp as la``: what a user of Python gets, and that the commands do the same."""

import ast
import inspect
import logging
import re
import xml.etree.ElementTree as ET
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from cli_shell import Shell
from hidden_arm import at, files_of_a_gain, session, tip
from places import ROOT
from small_arm import ARM

import longarm_comp as la
from longarm_comp.core.effects.catalogue import BUILT_IN
from longarm_comp.sim.hidden import drives
from longarm_comp.workflows.compensate import Commands
from longarm_comp.workflows.train import TrainedPredictor

QUICK = {"ensemble": 1, "hidden": 4}


@pytest.fixture(scope="module")
def arm(work: Path) -> la.Arm:
    return la.Arm.load(work / "arm.yaml")


@pytest.fixture(scope="module")
def samples(work: Path, arm: la.Arm) -> la.Session:
    return la.read_session(work / "samples.csv", arm)


@pytest.fixture(scope="module")
def model(work: Path, arm: la.Arm) -> la.Model:
    return la.load_model(work / "model.yaml", arm)


# ------------------------------------------------------------------ the names


def test_what_mypy_reads_is_what_is_imported() -> None:
    """The imports for type checkers, the table of lazy imports and `__all__` agree."""
    tree = ast.parse(Path(la.__file__).read_text("utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    typed = {
        alias.asname or alias.name: (entry.module, alias.name)
        for entry in block.body
        if isinstance(entry, ast.ImportFrom)
        for alias in entry.names
    }
    assert sorted(typed) == la.__all__ == sorted(la._MODULE_OF)
    for name, (module, original) in typed.items():
        found = getattr(la, name)
        if inspect.ismodule(found):
            assert found.__name__ == f"{module}.{original}"
        else:
            assert found.__module__ == module
            assert found.__name__ == name


def test_an_unknown_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="nonsense"):
        la.nonsense  # noqa: B018
    assert set(la.__all__) <= set(dir(la))


def test_every_effect_of_the_catalogue_is_in_the_namespace() -> None:
    for kind in BUILT_IN.values():
        assert getattr(la.effects, kind.__name__) is kind


# ------------------------------------------------------------------ ten lines


@pytest.mark.usefixtures("few_names")
def test_ten_lines_diagnose_train_compensate_and_reach(tmp_path: Path) -> None:
    """A wrong joint gain, lost markers, plain lists: the real tip comes to the targets."""
    gain = (drives.JointGain(at(2, 0.02)),)
    whole = session(gain, n=160)
    xyz = whole.xyz.copy()
    xyz[::20] = np.nan
    rows = la.Session.record(whole.q, xyz, approach=whole.approach)

    calibrated = la.calibrate(ARM, rows)
    found = la.diagnose(ARM, rows, test=session(gain, n=40, seed=2), network=False)
    predictor = la.train(ARM, rows, model=found.model, **QUICK)
    targets = la.Model(ARM).tip(ARM.mid + 0.3 * (whole.q[:12] - ARM.mid)).tolist()
    out = la.compensate(found.model, targets, predictor)

    assert [finding.name for finding in found.findings] == ["joint_gain"]
    assert found.verdict in ("named", "set")
    assert found.summary in repr(found)
    assert found.held_out["with_effects"].mean < found.held_out["calibrated"].mean
    assert predictor.samples == 152
    assert out.success.all()
    assert [len(out), out[0].command.tolist()] == [12, out.command[0].tolist()]

    def missed(commands: np.ndarray) -> float:
        return 1e3 * np.linalg.norm(tip(gain, commands, np.ones(12)) - targets, axis=1).mean()

    assert missed(la.compensate(la.Model(ARM), targets).command) > 3.0
    assert missed(out.command) < 0.3
    calibrated.save(tmp_path / "model.yaml")
    assert la.load_model(tmp_path / "model.yaml", ARM) == calibrated.model


@pytest.mark.usefixtures("few_names")
def test_the_page_says_what_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The program of docs/python.md, with small networks or none; every name has its row."""
    files_of_a_gain(tmp_path)
    page = (ROOT / "docs" / "python.md").read_text("utf-8")
    program = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert program is not None
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(la, "train", partial(la.train, ensemble=2, hidden=10))
    monkeypatch.setattr(la, "diagnose", partial(la.diagnose, network=False))
    names: dict[str, object] = {}
    exec(program[1], names)
    assert "network" in capsys.readouterr().out
    commands = names["commands"]
    assert isinstance(commands, Commands)
    assert commands.success.all()
    for name in set(la.__all__) - {"Context", "LongarmError", "Model", "Session", "write_poses"}:
        assert re.search(rf"^(- `{name}\b|.*`{name}`)", page, re.MULTILINE), name


# ------------------------------------------------------------------ the same as the commands


def test_calibrate_is_the_command(work: Path, shell: Shell, arm: la.Arm) -> None:
    words = ("--effect", "joint_gain", "--seed", 3, "--fraction", 0.3)
    told = shell.json("calibrate", work / "arm.yaml", work / "samples.csv", *words)
    kinds = la.effects.JointGain.for_arm(arm)
    for effects in (["joint_gain"], [kinds]):
        made = la.calibrate(arm, work / "samples.csv", effects=effects, seed=3, fraction=0.3)
        made.save("again.yaml")
        assert Path("again.yaml").read_bytes() == Path("model.yaml").read_bytes()
        assert made.held_out.rows == told["held_out"]
        assert [p.value for p in made.parameters] == [p["value"] for p in told["parameters"]]
        helped = made.held_out["joint_gain"].rms < made.held_out["geometry"].rms
        assert made.not_helping == (() if helped else ("joint_gain",))
    one = la.calibrate(arm, work / "samples.csv", effects=[la.effects.JointGain(joint=2)])
    assert [p.where for p in one.parameters if p.effect == "joint_gain"] == ["joint 2"]


def test_train_is_the_command(work: Path, arm: la.Arm, samples: la.Session, tmp_path: Path) -> None:
    """The predictor of the fixture was trained by the command."""
    made = la.train(arm, samples, model=work / "model.yaml", ensemble=2, hidden=10)
    made.save(tmp_path / "p.npz")
    assert (tmp_path / "p.npz").read_bytes() == (work / "predictor.npz").read_bytes()
    assert f"{made.samples} samples" in repr(made)
    assert made.after.mean < made.before.mean


def test_evaluate_is_the_command(work: Path, shell: Shell, arm: la.Arm) -> None:
    files = {"model": work / "model.yaml", "predictor": work / "predictor.npz"}
    words = [word for name, path in files.items() for word in (f"--{name}", path)]
    told = shell.json("evaluate", work / "arm.yaml", "--test", work / "test.csv", *words)
    model = la.load_model(files["model"], arm)
    predictor = la.load_predictor(files["predictor"], arm, files["model"])
    for made in (
        la.evaluate(arm, work / "test.csv", **files),
        la.evaluate(arm, la.read_session(work / "test.csv", arm), model=model, predictor=predictor),
    ):
        assert made.rows == told["rows"]
        assert made.outside == told["outside_training_data"]
        assert list(made) == ["rigid", "calibrated", "network"]
        assert made["network"].n == 30
        assert f"{told['rows'][1]['mean_mm']:.3f}" in repr(made)


def test_compensate_is_the_command(work: Path, shell: Shell, arm: la.Arm, model: la.Model) -> None:
    """Poses and positions in one file, each where it stood."""
    inside = ARM.mid + np.array([[0.1, 0.1, 0, 0], [0, 0.2, 0.01, 0], [0.2, 0, 0, 0.1]])
    xyz = la.Model(arm).tip(inside)
    Path("t.csv").write_text(
        "index,x,y,z,qx,qy,qz,qw\n"
        + "".join(
            f"{7 + k},{x},{y},{z},{'0,0,0,1' if k == 1 else ',,,'}\n"
            for k, (x, y, z) in enumerate(xyz)
        )
    )
    words = ("--model", work / "model.yaml", "--predictor", work / "predictor.npz")
    assert shell("compensate", work / "arm.yaml", "--targets", "t.csv", *words) == 3
    predictor = la.load_predictor(work / "predictor.npz", arm, work / "model.yaml")
    made = la.compensate(model, la.read_targets("t.csv"), predictor)
    made.save("again.csv")
    again, told = (re.split("[,\n]", Path(f).read_text()) for f in ("again.csv", "commands.csv"))
    for one, other in zip(again, told, strict=True):  # machine code rounds at another place
        assert one == other or float(one) == pytest.approx(float(other), abs=1e-9)
    assert [status.name for status in made.status] == ["SUCCESS", "UNREACHABLE", "SUCCESS"]
    assert made.success.tolist() == [True, False, True]
    assert made.summary == "3 targets: 2 success, 1 unreachable"
    alone = la.compensate(model, xyz[2].tolist(), predictor)[0]
    np.testing.assert_allclose(alone.command, made[2].command, atol=1e-9)
    assert [each.status for each in made[1:]] == list(made.status[1:])


def test_plan_is_the_command(work: Path, shell: Shell, arm: la.Arm) -> None:
    for kind in ("grid", "sobol"):
        words = ("--kind", kind, "-n", 9, "--seed", 4)
        told = shell.json("plan", work / "arm.yaml", *words)
        made = la.plan(arm, 9, kind=kind, seed=4)
        assert made.q.tolist() == told["poses"]
        assert made.approach.tolist() == told["approach"]
    la.write_poses(made, "next_poses.csv")
    assert np.allclose(la.plan(arm, 3, report=".").q, made.q[:3])
    with pytest.raises(la.InputError, match="kind"):
        la.plan(arm, 3, kind="spiral")


# ------------------------------------------------------------------ what is handled inside


def test_admission_speaks_where_it_is_listened_to(
    work: Path, arm: la.Arm, caplog: pytest.LogCaptureFixture
) -> None:
    few = la.read_session(work / "test.csv", arm)
    xyz = few.xyz.copy()
    xyz[3] = np.nan
    few = la.Session.record(few.q, xyz, source="bench 3")
    heard: list[str] = []
    la.evaluate(arm, few, note=heard.append)
    assert any(
        line.startswith("bench 3: ") and "nothing measured in 1 rows" in line for line in heard
    )
    assert not caplog.records
    with caplog.at_level(logging.INFO, "longarm_comp"):
        la.evaluate(arm, few)
    assert [record.message for record in caplog.records] == heard
    with pytest.raises(la.InputError, match="millimetres"):
        la.calibrate(arm, la.Session.record(few.q, 1e3 * few.xyz))


def test_a_predictor_is_used_with_its_own_model_only(
    work: Path, arm: la.Arm, model: la.Model, samples: la.Session, tmp_path: Path
) -> None:
    made = la.train(arm, samples, model=model, **QUICK)
    other = model.with_values(model.values * 1.01)
    target = la.Model(arm).tip(ARM.mid)
    assert la.compensate(model, target, made).success.all()
    with pytest.raises(la.InputError, match="the model that it was trained with"):
        la.compensate(other, target, made)
    with pytest.raises(la.InputError, match="the model that it was trained with"):
        la.evaluate(arm, samples, model=other, predictor=made)
    made.save(tmp_path / "p.npz")
    for right in (model, work / "model.yaml"):
        assert not isinstance(la.load_predictor(tmp_path / "p.npz", arm, right), TrainedPredictor)
    for wrong in (other, None):
        with pytest.raises(la.InputError, match="the model that it was trained with"):
            la.load_predictor(tmp_path / "p.npz", arm, wrong)
    with pytest.raises(la.InputError, match="the model that it was trained with"):
        la.load_predictor(work / "predictor.npz", arm)
    longer = la.Arm.parse({**arm.model_dump(exclude_none=True), "name": "another"}, "test")
    for use in (
        lambda: la.compensate(la.Model(longer), target, made),
        lambda: la.evaluate(longer, samples, predictor=made),
        lambda: la.train(longer, samples, model=model),
        lambda: la.load_predictor(tmp_path / "p.npz", longer, model),
    ):
        with pytest.raises(la.InputError, match="arm"):
            use()


def test_the_method_is_the_one_that_the_predictor_was_trained_for(
    arm: la.Arm, model: la.Model, samples: la.Session
) -> None:
    rigid = la.train(arm, samples, model=model, deflection=False, **QUICK)
    target = la.Model(arm).tip(ARM.mid)
    assert la.compensate(model, target, rigid)[0].passes > 0
    assert la.compensate(model, target, rigid, method="none")[0].passes == 0
    with pytest.raises(la.InputError, match="network: because the predictor was trained so"):
        la.compensate(model, target, rigid, method="both")
    with pytest.raises(la.InputError, match="none, deflection, network, both"):
        la.compensate(model, target, method="magic")


def test_compensate_takes_one_target_or_many(arm: la.Arm, model: la.Model) -> None:
    q = ARM.mid + np.array([[0.1, 0.1, 0, 0], [0, 0.2, 0.01, 0]])
    poses = np.array(model.pose(q))
    many = la.compensate(model, poses, seed=q, position_only=True)
    assert np.allclose(many.command, q, atol=1e-6)  # each started at its own joints
    assert la.compensate(model, poses[1], seed=q[1]).command.shape == (1, ARM.n)
    for wrong in ([], [1.0, 2.0], np.zeros((2, 4)), np.zeros((2, 3, 4))):
        with pytest.raises(la.InputError, match="targets"):
            la.compensate(model, wrong)
    with pytest.raises(la.InputError, match="seed"):
        la.compensate(model, poses, seed=np.tile(q, (2, 1)))
    with pytest.raises(la.InputError, match=r"seed: 'shape \(2,\)'"):
        la.compensate(model, poses, seed=[0.0, 0.1])
    lost = la.compensate(model, [[np.nan, 0.0, 0.0]])
    assert [status.name for status in lost.status] == ["BAD_TARGET"]


def test_what_is_shown_is_short(
    arm: la.Arm, model: la.Model, samples: la.Session, work: Path
) -> None:
    assert "120 rows of 4 joints, marker seen in 120" in repr(samples)
    assert repr(la.Model(arm)) == "Model(small: rigid)"
    assert "4 joint_zero" in repr(model)
    made = la.calibrate(arm, samples)
    assert "held-out mean error" in repr(made)
    for shown in (samples, model, made, la.compensate(model, la.Model(arm).tip(ARM.mid))):
        assert len(repr(shown)) < 200
    assert len(repr(made.held_out).splitlines()) == 5
    commands = la.compensate(model, la.Model(arm).tip(ARM.mid))
    for shown, held in (
        (arm, "joint4"),  (samples, f"{samples.q[0, 0]:.4g}"),
        (made, f"{made.held_out.rows[-1]['mean_mm']:.4g}"), (made.held_out, "geometry"),
        (commands, f"{commands.command[0, 1]:.4g}"),
    ):  # fmt: skip
        page = shown._repr_html_()
        assert held in page and len(repr(shown)) < 2000
        ET.fromstring(f"<all>{page}</all>")


def test_a_name_cannot_break_a_page(arm: la.Arm) -> None:
    named = la.Arm.parse({**arm.model_dump(mode="json"), "name": "<script>"}, "arm")
    assert "<script>" not in named._repr_html_()


def test_no_beam_is_left_out_without_a_word(demo_arm_path: Path) -> None:
    demo = la.Arm.load(demo_arm_path)
    assert f"{len(demo.links)} declared beams left out" in repr(la.Model(demo))
    assert "left out" not in repr(la.declared_model(demo))
    q = demo.mid
    assert np.linalg.norm(la.declared_model(demo).tip(q) - la.Model(demo).tip(q)) > 1e-3


def test_progress_is_told_a_step_a_line(
    arm: la.Arm, samples: la.Session, capsys: pytest.CaptureFixture[str]
) -> None:
    la.calibrate(arm, samples, progress=True)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[-1] for line in lines] == [
        *("frames_only", "joint_zeros", "geometry", "rows")
    ]  # fmt: skip
    la.calibrate(arm, samples)
    assert not capsys.readouterr().err


def test_a_table_of_another_program_is_a_session(
    arm: la.Arm, samples: la.Session, tmp_path: Path
) -> None:
    lines = ["A;B;C;D;X [mm];Y [mm];Z [mm]"]
    for q, xyz in zip(samples.q[:20], samples.xyz[:20], strict=True):
        turned = [np.degrees(q[0]), np.degrees(q[1]), 1e3 * q[2], np.degrees(q[3]), *(1e3 * xyz)]
        lines.append(";".join(f"{value:.9f}" for value in turned))
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    names = {"A": "q1:deg", "B": "q2:deg", "C": "q3:mm", "D": "q4:deg"}
    found = la.import_table(tmp_path / "log.csv", arm, names=names)
    np.testing.assert_allclose(found.q, samples.q[:20], atol=1e-9)
    np.testing.assert_allclose(found.xyz, samples.xyz[:20], atol=1e-9)
    assert found.source == "log.csv"


def test_mistakes_of_a_first_hour_are_named(arm: la.Arm, model: la.Model, tmp_path: Path) -> None:
    with pytest.raises(la.InputError, match="longarm import-urdf"):
        la.Arm.load(tmp_path / "boom.urdf")
    for wrong in ([["a", 2, 3]], [[1.0, 2.0], [3.0]]):
        with pytest.raises(la.InputError, match="targets"):
            la.compensate(model, wrong)
    saved = la.compensate(model, la.Model(arm).tip(ARM.mid)).save(tmp_path / "c.csv")
    assert saved == tmp_path / "c.csv" and saved.is_file()
