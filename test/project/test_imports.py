"""What is not imported where it is not needed: no node can wait seconds for scikit-learn."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from longarm_comp.cli.registry import COMMANDS
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.nodes.bringup import SIMULATED

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


def test_the_core_of_a_control_program_is_light_and_a_folder_needs_no_torch(tmp_path: Path) -> None:
    code = "import longarm_comp.core.compensation.compensate, longarm_comp.core.model.model_file\n"
    code += "import longarm_comp.core.learn.predictor_file, longarm_comp.core.learn.ensemble\n"
    code += f"import sys\nassert not {set(HEAVY)} & {{*sys.modules}}\n"
    mine = str(tmp_path / "mine")
    code += command_line("init", mine, "--like", "demo") + command_line("check", mine)
    assert "torch" not in loaded(code)


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="no ROS")
@pytest.mark.parametrize("sees", [False, True])
def test_no_node_loads_what_it_does_not_use(sees: bool) -> None:
    nodes = [node for node in SIMULATED if (node in ("stereo_bridge", "simulated_arm")) == sees]
    assert len(nodes) == (2 if sees else 3)
    found = loaded("".join(f"import longarm_comp.nodes.{node}\n" for node in nodes))
    assert "rclpy" in found
    assert found <= {"rclpy", "numba", *(["cv2"] if sees else [])}


def test_no_command_loads_what_it_does_not_use(work: Path, tmp_path: Path) -> None:
    """Judged, compensated, calibrated, trained: all without what other programs use."""
    arm, csv = str(work / "arm.yaml"), str(work / "samples.csv")
    learned = ("--model", str(work / "model.yaml"), "--predictor", str(work / "predictor.npz"))
    model, predictor = str(tmp_path / "model.yaml"), str(tmp_path / "predictor.npz")
    small = Arm.load(arm)
    target = [f"{each:.4f}" for each in declared_model(small).tip(small.mid)]
    code = "import sys\n"
    for words in (
        ("evaluate", arm, "--test", csv, *learned),
        ("compensate", arm, *target, "--position-only", *learned,
         "-o", str(tmp_path / "commands.csv")),
        ("calibrate", arm, csv, "-o", model),
    ):  # fmt: skip
        code += command_line(*words) + f"assert 'torch' not in sys.modules, {words!r}\n"
    code += command_line("train", arm, csv, "--model", model, "-o", predictor,
                         "--ensemble", "1", "--hidden", "3")  # fmt: skip
    found = loaded(code)
    assert not {"sklearn", "cv2", "rclpy"} & found
    assert "torch" in found, "what trains loads it; if nothing does, this tests nothing"
