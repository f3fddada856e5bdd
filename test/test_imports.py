"""What is not imported where it is not needed: torch takes seconds, and no node can wait for it."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_arm import ARM, measured

from bench.calibration import synthetic_session
from longarm_comp.cli.registry import COMMANDS
from longarm_comp.cli.run import run
from longarm_comp.core.arm.arm import Arm
from longarm_comp.nodes.bringup import SIMULATED
from longarm_comp.sessions.csv import write_csv
from longarm_comp.share import folder

HEAVY = ("torch", "sklearn", "matplotlib", "plotly", "cv2", "numba", "rclpy", "scipy", "rosbags")
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
    assert loaded(code + "import longarm_comp.core.learn.predictor_file\n") == set()


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="no ROS")
@pytest.mark.parametrize("node", SIMULATED)
def test_no_node_loads_what_it_does_not_use(node: str) -> None:
    found = loaded(f"import longarm_comp.nodes.{node}\n")
    assert "rclpy" in found
    allowed = {"rclpy", "numba", *(("cv2",) if node in ("stereo_bridge", "simulated_arm") else ())}
    assert found <= allowed | ({"scipy"} if node in ("stereo_bridge", "simulated_arm") else set())


def test_no_command_loads_torch_unless_a_device_is_asked_for(tmp_path: Path) -> None:
    """Calibrated, trained, judged, written as a bag: all without torch."""
    arm = folder("config") / "arm_demo.yaml"
    csv, out = tmp_path / "samples.csv", tmp_path / "out"
    write_csv(synthetic_session(Arm.load(arm), 80), csv)
    model, predictor = str(tmp_path / "model.yaml"), str(tmp_path / "predictor.npz")
    code = command_line("calibrate", str(arm), str(csv), "-o", model)
    code += command_line("train", str(arm), str(csv), "--model", model, "-o", predictor,
                         "--ensemble", "1", "--hidden", "3")  # fmt: skip
    code += command_line("evaluate", str(arm), "--test", str(csv), "--model", model)
    code += command_line("bag", "from-csv", str(arm), str(csv), "-o", str(out))
    assert "torch" not in loaded(code)


def test_a_device_that_is_not_there_is_one_clear_error(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("there is one")
    arm = tmp_path / "arm.yaml"
    arm.write_text(json.dumps(ARM.model_dump(mode="json", exclude_none=True)))
    write_csv(measured(40, rng), tmp_path / "samples.csv")
    words = ["train", str(arm), str(tmp_path / "samples.csv"), "--device", "cuda", "-o"]
    assert run([*words, str(tmp_path / "p.npz")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert "device" in said[0]
    assert "cuda" in said[0]
    assert not (tmp_path / "p.npz").exists()
