"""Libraries as Ubuntu 24.04 has them: refused in one line, with pip's command."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from places import ROOT

WITHOUT_METADATA = """
import importlib.metadata as metadata, runpy, sys, types
known = metadata.version
def version(name):
    if name.startswith(("opencv", "llvmlite")):
        raise metadata.PackageNotFoundError(name)
    return known(name)
metadata.version = version
"""
"""OpenCV and llvmlite are there, but not by pip."""


def refused(program: str, beside: Path, code: str = "") -> str:
    """What a program says that ends with 2, with a folder of other modules before all others."""
    code = f"{WITHOUT_METADATA}{code}\nrunpy.run_module({program!r}, run_name='__main__')"
    environment = os.environ | {"PYTHONPATH": f"{beside}{os.pathsep}{ROOT}"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 2
    return done.stderr


@pytest.mark.parametrize("program", ["longarm_comp", "longarm_comp.nodes.kinematics"])
def test_libraries_that_are_too_old_are_refused_in_one_line(program: str, tmp_path: Path) -> None:
    """One known to pip's metadata, one only by its module."""
    info = tmp_path / "pydantic-1.10.14.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: pydantic\nVersion: 1.10.14\n")
    old = "sys.modules['cv2'] = types.SimpleNamespace(__version__='4.6.0')"
    assert refused(program, tmp_path, old).splitlines() == [
        "longarm_comp: pydantic 1.10.14 is too old; OpenCV 4.6.0 is too old; "
        "run: pip install 'pydantic>=2.10' 'opencv-python-headless>=4.10'"
    ]


def test_a_library_that_cannot_be_imported_is_named_with_the_command(tmp_path: Path) -> None:
    """As Ubuntu's OpenCV, which was made for an older numpy than pip's."""
    (tmp_path / "cv2.py").write_text("raise ImportError('numpy.core failed\\n to import')\n")
    assert refused("longarm_comp.nodes.stereo_bridge", tmp_path) == (
        "longarm_comp: OpenCV cannot be used: numpy.core failed to import; "
        "run: pip install 'opencv-python-headless>=4.10'\n"
    )


def test_inverse_kinematics_without_its_compiler_is_refused_at_the_start(tmp_path: Path) -> None:
    (tmp_path / "llvmlite.py").write_text("raise ImportError('No module named llvmlite')\n")
    assert refused("longarm_comp.nodes.kinematics", tmp_path) == (
        "longarm_comp: llvmlite cannot be used: No module named llvmlite; "
        "run: pip install 'llvmlite>=0.43'\n"
    )
