"""What is not imported where it is not needed: no node can wait seconds for scikit-learn."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from bench.calibration import synthetic_session
from bench.dummy_predictor import train_dummy
from longarm_comp.cli.registry import COMMANDS
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.nodes.bringup import SIMULATED
from longarm_comp.sessions.csv import write_csv
from longarm_comp.share import folder

HEAVY = ("sklearn", "matplotlib", "cv2", "numba", "rclpy", "scipy", "rosbags", "torch")
_TELL = f"""
import json, sys
print(json.dumps([name for name in {HEAVY!r} if name in sys.modules]))
"""


def loaded(code: str) -> set[str]:
    """The heavy libraries that a Python process has loaded at its end."""
    done = subprocess.run(
        [sys.executable, "-c", code + _TELL], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


def command_line(*words: str) -> str:
    return f"from longarm_comp.cli.run import run\nassert run({list(words)!r}) == 0\n"


def test_importing_the_package_loads_nothing_but_its_version() -> None:
    code = f"""
import sys
before = set(sys.modules)
import longarm_comp
dir(longarm_comp)
print(sorted(set(sys.modules) - before))
assert longarm_comp.Arm and "numpy" in sys.modules and {HEAVY[0]!r} not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "['longarm_comp', 'longarm_comp.version']"


def test_help_and_the_list_of_commands_load_nothing_heavy() -> None:
    every = "".join(command_line(*entry.name.split(), "--help") for entry in COMMANDS)
    assert loaded(command_line("--help") + every) == set()


def test_the_core_of_a_control_program_is_light() -> None:
    code = "import longarm_comp.core.compensation.compensate, longarm_comp.core.model.model_file\n"
    code += "import longarm_comp.core.learn.predictor_file, longarm_comp.core.learn.ensemble\n"
    assert loaded(code) == set()


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="no ROS")
@pytest.mark.parametrize("node", SIMULATED)
def test_no_node_loads_what_it_does_not_use(node: str) -> None:
    found = loaded(f"import longarm_comp.nodes.{node}\n")
    assert "rclpy" in found
    assert found <= {
        "rclpy",
        "numba",
        *(["cv2"] if node in ("stereo_bridge", "simulated_arm") else []),
    }


def test_no_command_loads_what_it_does_not_use(tmp_path: Path) -> None:
    """Calibrated, trained, judged: all without what other programs use."""
    arm = folder("config") / "arm_demo.yaml"
    csv = tmp_path / "samples.csv"
    write_csv(synthetic_session(Arm.load(arm), 40), csv)
    model, predictor = str(tmp_path / "model.yaml"), str(tmp_path / "predictor.npz")
    code = command_line("calibrate", str(arm), str(csv), "-o", model)
    code += command_line("train", str(arm), str(csv), "--model", model, "-o", predictor,
                         "--ensemble", "1", "--hidden", "3")  # fmt: skip
    code += command_line("evaluate", str(arm), "--test", str(csv), "--model", model)
    found = loaded(code)
    assert not {"sklearn", "cv2", "rclpy"} & found
    assert "torch" in found, "what trains loads it; if nothing does, the tests below test nothing"
    train_dummy(Arm.load(arm), Path(predictor))  # what was learned above does not help
    demo = Arm.load(arm)
    target = [f"{each:.4f}" for each in declared_model(demo).tip(demo.mid)]
    with_predictor, mine = ("--model", model, "--predictor", predictor), str(tmp_path / "mine")
    code = ""
    for words in (
        ("init", mine, "--like", "demo"),
        ("check", mine),
        ("evaluate", str(arm), "--test", str(csv), *with_predictor),
        ("compensate", str(arm), *target, "--position-only", "--predictor", predictor,
         "-o", str(tmp_path / "commands.csv")),
    ):  # fmt: skip
        code += command_line(*words) + f"assert 'torch' not in sys.modules, {words!r}\n"
    assert "torch" not in loaded("import sys\n" + code)
