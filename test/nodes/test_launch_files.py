"""Configuration and launch files against the nodes that read them, without starting any."""

import ast
import importlib
import os
import signal
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from places import ROOT

pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.yaml_file import read_yaml
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.devices.state_folder import state_folder
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.bringup import GUARD, SIMULATED, BringUp
from longarm_comp.nodes.params import Param
from longarm_comp.share import folder

GIVEN_BY_BRING_UP = {"arm", "model", "predictor", "servos", "port", "hidden"}


def table(node: str) -> dict[str, Param]:
    params = importlib.import_module(f"longarm_comp.nodes.{node}").PARAMS
    return {param.name: param for param in params}


def flat(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    made: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, dict):
            made |= flat(value, f"{prefix}{key}.")
        else:
            made[prefix + key] = value
    return made


def in_file(node: str) -> dict[str, Any]:
    data = read_yaml(folder("config") / f"{node}.yaml")
    (name,) = data
    assert name == f"/**/{node}"
    return flat(data[name]["ros__parameters"])


@pytest.mark.parametrize("node", [*SIMULATED, "trajectory_compensator"])
def test_every_parameter_is_described_and_the_file_lists_them_all(node: str) -> None:
    known, listed = table(node), in_file(node)
    servo = {name for name in listed if name.split(".")[0] in ServoConfig.model_fields}
    assert all(param.description for param in known.values())
    assert set(listed) - servo <= set(known)
    unlisted = set(known) - set(listed) - GIVEN_BY_BRING_UP
    assert not unlisted, f"config/{node}.yaml lacks {sorted(unlisted)}"
    for name in set(listed) - servo:
        assert known[name].check(listed[name]) == known[name].default, name
    text = (folder("config") / f"{node}.yaml").read_text("utf-8")
    for name in set(listed) - servo:
        assert known[name].comment in text, name


def test_the_servo_file_fits_the_demonstration_arm() -> None:
    arm = Arm.load(folder("config") / "arm_demo.yaml")
    servos = ServoConfig.load(folder("config") / "servo_driver.yaml")
    assert tuple(servos.joints) == arm.joint_names
    for name, lower, upper in zip(arm.joint_names, arm.lower, arm.upper, strict=True):
        joint = servos.joints[name]
        assert joint.lower == pytest.approx(lower, abs=1e-6)
        assert joint.upper == pytest.approx(upper, abs=1e-6)


def test_names_are_relative_and_appear_once() -> None:
    names = [topic.name for topic in graph.TOPICS] + [service.name for service in graph.SERVICES]
    assert len(set(names)) == len(names)
    shared = {"/diagnostics", *(("/tf", "/tf_static") if graph.HAS_TF else ())}
    assert {name for name in names if name.startswith("/")} == shared


@pytest.mark.parametrize(
    ("param", "value"),
    [
        (Param("gain", 1.0, "", 0.0, 2.0), 3.0),
        (Param("gain", 1.0, ""), "1"),
        (Param("count", 1, "", 1, 9), 2.0),
        (Param("flag", True, ""), 1),
        (Param("name", "a", "", choices=("a", "b")), "c"),
        (Param("xyz", [0.0, 0.0, 0.0], ""), [1.0, 2.0]),
    ],
)
def test_a_wrong_parameter_is_refused(param: Param, value: object) -> None:
    with pytest.raises(ValueError):
        param.check(value)


def test_a_whole_number_is_taken_for_a_float() -> None:
    assert Param("gain", 1.0, "", 0.0, 5.0).check(2) == 2.0


def test_bring_up_scales_the_simulation_and_leaves_hardware_alone(tmp_path: Path) -> None:
    arm = folder("config") / "arm_demo.yaml"
    real = BringUp(arm=arm, port="/dev/ttyACM0")
    given = {"arm": str(arm), "bus.port": "/dev/ttyACM0"}
    assert real.parameters("servo_driver", "unused") == given
    assert "simulated_arm" not in real.nodes
    fast = BringUp(arm=arm, sim=True, speed=4.0)
    scaled = fast.parameters("servo_driver", "/tmp/bus")
    assert scaled["joints.joint1.max_velocity"] == pytest.approx(1.6)
    assert scaled["bus.port"] == "/tmp/bus"
    assert Path(scaled["state"]).parent == state_folder() / "simulated"  # not the real arm's stops
    learned = fast.parameters("kinematics", "/tmp/bus")["learned_file"]
    assert Path(learned).parent == Path(scaled["state"])  # nor what the real arm learned
    others = (replace(fast, namespace=name) for name in ("left", "/right/", "/a/b"))
    theirs = {each.parameters("kinematics", "unused")["learned_file"] for each in others}
    assert {Path(path).parent for path in theirs} == {Path(learned).parent}
    assert len({*theirs, learned}) == 4  # each simulated arm has its own
    assert "learned_file" not in real.parameters("kinematics", "unused")
    assert scaled["follower.lost_error_ticks"] == pytest.approx(1600.0)
    assert scaled["follower.max_step_s"] == pytest.approx(0.025)
    assert scaled["joints.joint1.top_speed_ticks_s"] == pytest.approx(4 * 50 / 60 * 4096)
    fastest = replace(fast, speed=100.0).parameters("servo_driver", "/tmp/bus")
    assert fastest["follower.lost_error_ticks"] == 2048.0  # what the driver takes
    (tmp_path / "servo_driver.yaml").write_text("joints: {}\n")
    own = BringUp(arm=arm, sim=True, speed=4.0, config=tmp_path)
    assert own.file("kinematics") == folder("config") / "kinematics.yaml"
    with pytest.raises(InputError, match="ros__parameters"):
        own.parameters("servo_driver", "")


def test_files_with_effects_reach_the_node_that_loads_models() -> None:
    files = (ROOT / "examples" / "custom_effect.py", Path("mine.py"))
    graph = BringUp(arm=folder("config") / "arm_demo.yaml", effects=files)
    words = ["--effects", str(files[0]), "--effects", str(Path.cwd() / "mine.py")]
    assert graph.arguments("kinematics") == graph.arguments("trajectory_compensator") == words
    assert graph.arguments("error_predictor") == []
    assert "effects" not in graph.parameters("kinematics", "")


def test_the_calibration_of_a_folder_reaches_real_cameras_only(tmp_path: Path) -> None:
    arm = tmp_path / "arm.yaml"
    arm.write_text((folder("config") / "arm_demo.yaml").read_text("utf-8"))
    graph = BringUp(arm=arm)
    (tmp_path / "cameras").mkdir()
    (tmp_path / "cameras" / "left.yaml").write_text("")
    assert graph.parameters("stereo_bridge", "") == {}
    (tmp_path / "cameras" / "right.yaml").write_text("")
    assert graph.parameters("stereo_bridge", "") == {"cameras": str(tmp_path / "cameras")}
    assert replace(graph, sim=True).parameters("stereo_bridge", "") == {}


LAUNCH_FILES = sorted((ROOT / "launch").glob("*.launch.py"))


def launched(file: Path, monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """A launch file, run. `launch` is in no registry: stand-ins only keep their arguments."""
    for name in (
        *("launch", "launch.actions", "launch.event_handlers", "launch.substitutions"),
        *("launch.launch_description_sources", "launch_ros", "launch_ros.actions"),
        *("launch.events", "launch.events.process"),
    ):
        monkeypatch.setitem(sys.modules, name, MagicMock(name=name))
    module = types.ModuleType(file.stem)
    module.__file__ = str(file)
    source = file.read_text("utf-8")
    exec(compile(ast.parse(source), str(file), "exec"), module.__dict__)
    return module


@pytest.mark.parametrize("file", LAUNCH_FILES, ids=lambda file: file.name)
def test_a_launch_file_describes_itself(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = launched(file, monkeypatch)
    module.generate_launch_description()
    (entities,), _ = module.LaunchDescription.call_args
    assert len(entities) >= 2


def test_a_launch_starts_every_node_with_what_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    module = launched(ROOT / "launch" / "longarm.launch.py", monkeypatch)
    arguments = {name: default or "" for name, default, _ in module.ARGUMENTS}
    arm = str(folder("config") / "arm_demo.yaml")
    mine = "mine.py"
    given = {**arguments, "arm": arm, "sim": "true", "rviz": "true", "effects": mine}
    module.LaunchConfiguration = lambda name: types.SimpleNamespace(
        perform=lambda context: given[name]
    )
    made = module.nodes(None)
    assert len(made) == len(SIMULATED) + 3
    (signalled,) = module.SignalProcess.call_args_list  # as launch sends none on SIGINT
    assert signalled.kwargs["signal_number"] == signal.SIGINT
    assert signalled.kwargs["process_matcher"](module.Node.return_value)
    assert not signalled.kwargs["process_matcher"]("of another launch file")
    calls = [call.kwargs for call in module.Node.call_args_list][: len(SIMULATED)]
    assert [call["executable"] for call in calls] == list(SIMULATED)
    passed = {}
    for call in calls:
        assert call["name"] == call["executable"]
        told = ["--effects", str(Path.cwd() / mine)] if call["name"] == "kinematics" else []
        assert call["arguments"] == told
        assert call["additional_env"] == {GUARD: str(os.getpid())}  # it ends when launch was killed
        *listed, written = call["parameters"]
        for file, (node, values) in zip(listed, read_yaml(Path(written)).items(), strict=True):
            passed[node.removeprefix("/**/")] = [file, values["ros__parameters"]]
    assert set(passed) == set(SIMULATED)
    for node, parameters in passed.items():
        passes_what_the_node_has(node, *parameters)
        assert node == "stereo_bridge" or parameters[1]["arm"] == arm


def test_only_the_driver_ends_a_launch_and_no_node_starts_again_with_bad_input(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    module = launched(ROOT / "launch" / "longarm.launch.py", monkeypatch)

    def after(name: str, code: int, action: str = "mine") -> object:
        event = types.SimpleNamespace(returncode=code, process_name=name, action=action)
        return module.end_on_bad_input(event, ["mine", "too"])

    for code in (0, 1, -9):
        assert after("servo_driver-3", code) is None and after("kinematics-4", code) is None
    assert after("servo_driver-3", 2) == [module.Shutdown.return_value]
    assert after("kinematics-4", 2, "of another arm") is None  # whose own handler says it
    assert after("kinematics-4", 2) == [module.LogInfo.return_value, module.EmitEvent.return_value]
    (said,), (ended,) = module.LogInfo.call_args_list, module.ShutdownProcess.call_args_list
    assert "kinematics-4" in said.kwargs["msg"] and "not started again" in said.kwargs["msg"]
    assert ended.kwargs["process_matcher"]("mine") and not ended.kwargs["process_matcher"]("too")


@pytest.mark.parametrize("name", ["longarm.rviz", "two_arms.rviz"])
def test_rviz_shows_topics_and_frames_that_there_are(name: str) -> None:
    view = read_yaml(ROOT / "config" / name)["Visualization Manager"]
    topics = {d["Topic"]["Value"] for d in view["Displays"] if "Topic" in d}
    sides = ("left_arm", "right_arm") if name == "two_arms.rviz" else ("",)
    known = {f"/{side}/{t.name}" if side else t.name for side in sides for t in graph.TOPICS}
    assert topics <= known
    assert {t for t in topics if t.endswith("markers")} == {
        f"/{side}/markers" if side else "markers" for side in sides
    }
    frames = {d["Reference Frame"] for d in view["Displays"] if "Reference Frame" in d}
    assert frames == {f"{side}/base" if side else "base" for side in sides}


def passes_what_the_node_has(node: str, listed: str, given: dict[str, Any]) -> None:
    """The parameter file is there, and each value on top of it is one that the node takes."""
    assert Path(listed).is_file()
    known = table(node)
    for name, value in given.items():
        if name.split(".")[0] in ServoConfig.model_fields:
            assert name in in_file(node) or name == "bus.port", name
        else:
            known[name].check(value)


@pytest.mark.parametrize(
    "file", [file for file in LAUNCH_FILES if file.name != "longarm.launch.py"],
    ids=lambda file: file.name,
)  # fmt: skip
def test_what_includes_another_launch_file_passes_arguments_that_it_has(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = launched(ROOT / "launch" / "longarm.launch.py", monkeypatch)
    known = {name for name, _, _ in whole.ARGUMENTS}
    needed = {name for name, default, _ in whole.ARGUMENTS if default is None}
    module = launched(file, monkeypatch)
    module.generate_launch_description()
    includes = module.IncludeLaunchDescription.call_args_list
    assert includes
    for call in includes:
        passed = dict(call.kwargs["launch_arguments"])
        assert needed <= set(passed) <= known
    named = [call.args[0] for call in module.PythonLaunchDescriptionSource.call_args_list]
    assert {Path(name) for name in named} == {ROOT / "launch" / "longarm.launch.py"}
    declared = {call.args[0] for call in module.DeclareLaunchArgument.call_args_list}
    used = {call.args[0] for call in module.LaunchConfiguration.call_args_list}
    assert used <= declared
    if "STANDS" in module.__dict__:  # all files of each arm may be given
        every = known - {"sim", "rviz", "namespace"}
        assert {f"{side}_{name}" for side in module.STANDS for name in every} <= declared
