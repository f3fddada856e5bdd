"""The examples, run as a user runs them; what they print is what they promise."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from places import EXAMPLES


def printed(name: str, folder: Path) -> str:
    """What an example prints, run in an empty folder, in which it leaves nothing behind."""
    done = subprocess.run(
        [sys.executable, EXAMPLES / name],
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert not list(folder.iterdir())
    return done.stdout


def figures(said: str, unit: str = "mm") -> dict[str, float]:
    """The first length on every line that begins with a name."""
    rows = re.findall(rf"^ *(\w[\w -]*?)  +.*?([\d.]+) {unit}", said, re.MULTILINE)
    return {name: float(value) for name, value in rows}


def test_first_calibration(tmp_path: Path) -> None:
    said = printed("first_calibration.py", tmp_path)
    mean = figures(said)
    assert list(mean) == ["nominal", "frames_only", "joint_zeros", "geometry"]
    assert mean["nominal"] > 5.0
    assert mean["geometry"] < 0.6
    differ = re.search(r"by ([\d.]+) mm in the mean", said)
    assert differ is not None
    assert float(differ[1]) < 0.25  # the noise of a sighting is 0.36 mm and more


@pytest.mark.long
def test_closing_the_loop(tmp_path: Path) -> None:
    said = printed("closing_the_loop.py", tmp_path)
    assert "['joint_gain']" in said
    missed = figures(said)
    assert list(missed) == ["rigid arm", "calibrated", "with the effect", "and the network"]
    assert missed["rigid arm"] > 10.0
    assert missed["with the effect"] < 0.4 * missed["calibrated"]
    assert missed["and the network"] < 0.3


@pytest.mark.long
def test_online_loop(tmp_path: Path) -> None:
    said = printed("online_loop.py", tmp_path)
    alarms = [int(k) for k in re.findall(r"target (\d+): .*; calibrating again", said)]
    assert len(alarms) == 1  # none before the arm slips, none after it is calibrated again
    assert 40 <= alarms[0] < 60
    error = figures(said)
    assert list(error) == ["calibrated", "slipped", "calibrated again"]
    assert error["slipped"] > 1.5 * error["calibrated again"]
