"""No file of data names code: nothing that lies in a folder is executed (SECURITY.md)."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from cli_shell import Shell
from forked import ForkedProgram
from places import ROOT
from small_arm import ARM, measured

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.core.learn.predictor_file import load
from longarm_comp.core.processes import run_module
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.sessions.csv import write_csv
from longarm_comp.share import folder

EVIL = "import pathlib\npathlib.Path({!r}).touch()\n"


@pytest.fixture
def trap(tmp_path: Path) -> Path:
    """A Python file in the folder of data; it leaves a file `executed` beside itself."""
    path = tmp_path / "evil.py"
    path.write_text(EVIL.format(str(tmp_path / "executed")))
    return path


def executed(trap: Path) -> bool:
    return trap.with_name("executed").exists()


def program(cwd: Path, *words: object) -> tuple[int, str]:
    """Exit code and errors of `longarm`, as it is installed, started in a folder."""
    done = subprocess.run(
        [str(Path(sys.executable).with_name("longarm")), *map(str, words)],
        cwd=cwd, capture_output=True, text=True, timeout=300, check=False,
        env={k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"},
    )  # fmt: skip
    return done.returncode, done.stderr


def parameters(node: str, **given: object) -> str:
    return yaml.safe_dump({f"/**/{node}": {"ros__parameters": given}})


@pytest.mark.parametrize(
    ("node", "option"),
    [
        ("kinematics", "effects"),
        ("trajectory_compensator", "effects"),
        ("servo_driver", "effects"),
        ("error_predictor", "network"),
    ],
)
@pytest.mark.parametrize("place", ["", "config"])
def test_a_parameter_file_beside_the_arm(trap: Path, node: str, option: str, place: str) -> None:
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
    from longarm_comp.nodes.bringup import BringUp, running

    at, arm = trap.parent, trap.with_name("arm.yaml")
    arm.write_text((folder("config") / "arm_demo.yaml").read_text("utf-8"))
    (at / place).mkdir(exist_ok=True)
    text = (folder("config") / f"{node}.yaml").read_text("utf-8")
    (at / place / f"{node}.yaml").write_text(f"{text}    {option}: {trap}\n")
    config = at / place if place else None
    graph = BringUp(arm=arm, sim=True, paths=True, config=config)
    said = rf"{node}\.yaml: {option}: .*--{option} FILE of a command"
    with pytest.raises(InputError, match=said), running(graph):
        pass
    assert not executed(trap)


def test_longarm_up_says_it_in_one_line(trap: Path) -> None:
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
    trap.with_name("arm.yaml").write_text((folder("config") / "arm_demo.yaml").read_text("utf-8"))
    deep = {"/**": {"kinematics": {"ros__parameters": {"effects": str(trap)}}}}
    trap.with_name("kinematics.yaml").write_text(yaml.safe_dump(deep))
    code, said = program(trap.parent, "up", "arm.yaml", "--sim", "--namespace", "trap")
    assert code == 2 and "Traceback" not in said
    assert "kinematics.yaml: effects: " in said.splitlines()[-1]
    assert not executed(trap)


@pytest.mark.parametrize(
    ("node", "option"), [("kinematics", "effects"), ("error_predictor", "network")]
)
def test_a_node_takes_it_from_its_command_line_only(trap: Path, node: str, option: str) -> None:
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
    arm = folder("config") / "arm_demo.yaml"
    file = trap.with_name(f"{node}.yaml")
    file.write_text(parameters(node, arm=str(arm), **{option: str(trap)}))
    ros = ("--ros-args", "--params-file", file)

    def ran(*words: object) -> tuple[int, str]:
        """Exit code of the node in the folder of the trap, and what it said."""
        with tempfile.TemporaryFile("w+") as heard:
            asked = [f"longarm_comp.nodes.{node}", *map(str, (*words, *ros))]
            code = ForkedProgram(asked, str(trap.parent), dict(os.environ), heard).wait(300)
            heard.seek(0)
            return code, heard.read()

    code, said = ran()
    assert (code, executed(trap)) == (2, False), said
    *_, last = said.splitlines()  # the middleware may speak before
    assert option in last and "Traceback" not in said
    wrong = (["--effect", trap], [f"--{option}"], [trap, f"--{option}"])
    for words in wrong if node == "kinematics" else ():  # one reader of words for all nodes
        code, said = ran(*words)
        assert (code, executed(trap)) == (2, False), said
        assert "command line: arguments: " in said
    code, said = ran(f"--{option}", trap)
    assert executed(trap), said  # and then it is refused, because it defines nothing
    assert code == 2 and "Traceback" not in said


def test_modules_of_the_folder_where_the_program_is_started(trap: Path) -> None:
    """Nodes and workers would import these in place of their own."""
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
    from longarm_comp.nodes.bringup import BringUp

    for name in ("yaml", "numpy", "rclpy", "multiprocessing", "longarm_comp", "sitecustomize"):
        (trap.parent / name).mkdir()
        (trap.parent / name / "__init__.py").write_text(trap.read_text())
    graph = BringUp(arm=folder("config") / "arm_demo.yaml", sim=True, paths=True)
    for name, words in graph.commands(trap.with_name("scratch")).items():
        start = run_module(f"longarm_comp.nodes.{name}")
        assert words[: len(start)] == start
    bad = [*start, "--ros-args", "-p", "no_such_parameter:=1"]
    done = subprocess.run(
        bad, cwd=trap.parent, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 2 and "no_such_parameter" in done.stderr, done.stderr
    assert not executed(trap)


@pytest.mark.parametrize("engine", [(), ("--dask", "local")])
def test_workers_of_a_fleet(trap: Path, engine: tuple[str, ...]) -> None:
    if engine:
        pytest.importorskip("dask.distributed", reason="dask is not installed")
    (trap.parent / "multiprocessing").mkdir()
    (trap.parent / "multiprocessing" / "__init__.py").write_text(trap.read_text())
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    for name in "ab":
        (trap.parent / "arms" / name).mkdir(parents=True)
        (trap.parent / "arms" / name / "arm.yaml").write_text(yaml.safe_dump(data))
        session = measured(3, np.random.default_rng(1))  # too few: refused at once
        write_csv(session, trap.parent / "arms" / name / "samples.csv")
    words = ("arms", "--jobs", 1 if engine else 2, "-o", "out", "--no-network", *engine)
    _, said = program(trap.parent, "fleet", *words)
    made = trap.parent / "out" / "fleet.json"
    assert made.is_file(), said
    told = {arm["name"]: arm["verdict"] for arm in json.loads(made.read_text("utf-8"))["arms"]}
    assert told == {"a": "failed", "b": "failed"}
    assert not executed(trap)


def test_benchmarks_and_studies_of_the_folder(trap: Path) -> None:
    for name, command in (("bench", ["bench", "--list"]), ("studies", ["study", "loop"])):
        (trap.parent / name).mkdir()
        (trap.parent / name / "__init__.py").write_text(trap.read_text())
        program(trap.parent, *command)
    assert not executed(trap)


@pytest.mark.parametrize("protocol", ["evil.py", "evil:Protocol", "longarm_comp.cli"])
def test_a_servo_protocol_is_a_name_of_those_installed(trap: Path, protocol: str) -> None:
    text = (folder("config") / "servo_driver.yaml").read_text("utf-8")
    path = trap.with_name("servo_driver.yaml")
    path.write_text(text.replace("protocol: feetech", f"protocol: '{protocol}'"))
    assert protocol in path.read_text()
    with pytest.raises(InputError, match=r"bus\.protocol: .*one of "):
        ServoConfig.load(path)
    assert not executed(trap)


def test_yaml_tags_and_an_effect_that_a_model_names(trap: Path, shell: Shell) -> None:
    data = ARM.model_dump(mode="json", exclude_defaults=True)
    trap.with_name("arm.yaml").write_text(yaml.safe_dump(data))
    write_csv(measured(60, np.random.default_rng(1)), trap.with_name("s.csv"))
    assert shell("calibrate", "arm.yaml", "s.csv", "-o", "model.yaml") == 0
    model = trap.with_name("model.yaml")
    made = model.read_text()
    names = f"effects:\n- effect: evil.py\n  origin: file {trap}\n  parameters: {{}}\n"
    for text in (made + names, f"!!python/object/apply:os.system ['touch {trap}.done']\n"):
        model.write_text(text)
        shell.refused("evaluate", "arm.yaml", "--test", "s.csv", "--model", "model.yaml")
    assert not executed(trap) and not trap.with_name("evil.py.done").exists()


class _Pickled:
    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self._path,)


def test_a_network_holds_no_pickle(trap: Path) -> None:
    held = np.array([_Pickled(trap.with_name("executed"))], dtype=object)
    path = trap.with_name("predictor.npz")
    np.savez(path, header=held, w=held)
    with pytest.raises(InputError, match=r"predictor\.npz"):
        load(path)
    assert not executed(trap)


def test_what_matplotlib_reads_of_the_folder(trap: Path) -> None:
    backend = "backend: module://evil\naxes.prop_cycle: __import__('evil')\n"
    trap.with_name("matplotlibrc").write_text(backend)
    code, said = program(trap.parent, "stereo", "marker", "--board", "7x5", "-o", "board.pdf")
    assert (code, executed(trap)) == (0, False), said


@pytest.mark.usefixtures("catalogue_of_ours")
def test_a_graph_that_is_given_the_file_knows_its_effects(tmp_path: Path) -> None:
    """The words with which `longarm up --effects` starts its nodes."""
    pytest.importorskip("rclpy", reason="ROS 2 is not installed: run make setup")
    from nodes_bench import bench
    from own_graph import own_graph
    from std_srvs.srv import Trigger

    from longarm_comp.core.effects.catalogue import load_file
    from longarm_comp.core.model.model import Model
    from longarm_comp.core.model.model_file import save_model, store
    from longarm_comp.nodes import interfaces as graph
    from longarm_comp.nodes.bringup import BringUp

    example = ROOT / "examples" / "custom_effect.py"
    (coupling,) = load_file(example)
    file, model = folder("config") / "arm_demo.yaml", tmp_path / "model.yaml"
    arm = Arm.load(file)
    save_model(model, store(Model(arm, (coupling(joint=5, driver=2, gain=0.03),))))
    with own_graph(tmp_path), bench() as stage:
        for space, effects in (("with", (example,)), ("without", ())):
            made = BringUp(arm=file, model=model, effects=effects, namespace=space)
            stage.python(made.commands(tmp_path / space)["kinematics"][1:])
            client = graph.RELOAD.client(stage.node, of=f"/{space}/kinematics")
            answer = stage.call(client, Trigger.Request())
            assert answer.success == bool(effects), answer.message
    assert "cable_coupling" in answer.message and "--effects" in answer.message


@pytest.mark.parametrize(
    "text",
    [
        '<?xml version="1.0" encoding="evil"?><robot name="a"/>',
        '<!DOCTYPE r [<!ENTITY e SYSTEM "evil.py">]><robot name="&e;"/>',
        '<robot name="a" xmlns:xacro="x"><xacro:property name="p" value="${evil}"/></robot>',
    ],
)
def test_a_urdf_names_no_code_and_no_file(
    trap: Path, text: str, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though Python would find the trap by its name."""
    monkeypatch.syspath_prepend(trap.parent)
    monkeypatch.delitem(sys.modules, "evil", raising=False)
    trap.with_name("arm.urdf").write_text(text)
    words = ("import-urdf", "arm.urdf", "--base", "a", "--tip", "b", "-o", "out.yaml")
    assert shell.refused(*words) and not executed(trap)
    assert len(shell.err.splitlines()) == 1 and "touch" not in shell.err
