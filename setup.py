"""The build of longarm_comp: pip and colcon (ament_python) both read this file."""

import sys
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = "longarm_comp"

# Programs that `ros2 run longarm_comp ...` finds: the modules of nodes/ that have a main.
NODES = [
    "error_predictor",
    "kinematics",
    "servo_driver",
    "simulated_arm",
    "stereo_bridge",
    "trajectory_compensator",
]

RUNTIME = [
    "click>=8.1",
    "jinja2>=3.1",
    "llvmlite>=0.43",
    "matplotlib>=3.8",
    "numpy>=1.26",
    "openpyxl>=3.1",
    "opencv-python-headless>=4.10",
    "pandas>=2.1",
    "pydantic>=2.10",
    "pyserial>=3.5",
    "pyyaml>=6.0",
    "rich>=13.7",
    "rosbags>=0.10",
    "ruamel.yaml>=0.17.21",
    "safetensors>=0.4.3",
    "scipy>=1.12",
    "torch>=2.4",
    "typing-extensions>=4.6",
]

PEERS = ["ikpy", "mcap-ros2-support", "pytracik", "roboplan", "roboticstoolbox-python"]
STUDIES = ["joblib>=1.4", "scikit-learn>=1.4"]
CLUSTER = ["dask[distributed]>=2024.1"]
DOCS = ["furo>=2024.8", "myst-nb>=1.1", "pillow>=10.1", "sphinx>=7.4"]
VIEW = ["viser==1.1.1", "websockets>=14"]  # pinned: longarm_comp/view/server.py wraps how it serves

PATH = ["toppra>=0.6"]  # wheels for Python 3.10 to 3.13

EXTRAS = {
    "test": ["pytest"],  # by this name colcon test finds that pytest runs the tests
    "bench": PEERS,  # longarm bench, what it compares with
    "studies": STUDIES,  # longarm study table1, study loop
    "cluster": [*STUDIES, *CLUSTER],  # longarm fleet --dask, study loop --dask
    "docs": DOCS,  # make docs
    "view": VIEW,  # longarm view
    "path": PATH,  # limits of velocity and acceleration along compensated paths
    "dev": [
        *STUDIES,
        *CLUSTER,
        *DOCS,
        *VIEW,
        *PATH,
        "PyNiteFEA",
        "build",
        "catkin-pkg",
        "colcon-common-extensions",
        "dynamixel-sdk",
        "example-robot-data",
        "hypothesis",
        "msgspec",
        "mujoco>=3.2",  # examples/mujoco_arm.py
        "mypy",
        "packaging",
        "pin",
        "playwright",
        "pytest",
        "pytest-rerunfailures",
        "pytest-timeout",
        "pytest-xdist",
        "ruff",
        "types-PyYAML",
        "vassar-feetech-servo-sdk",
    ],
}

# Files beside the modules that read them: page templates.
DATA_KINDS = ["css", "j2", "js"]

ROOT = Path(__file__).parent


def programs():
    """Of a wheel: what `ros2 run` and `ros2 launch` look for below lib, which runs that in bin.

    colcon needs none: it puts the programs themselves there (setup.cfg).
    """
    if "bdist_wheel" not in sys.argv:
        return []
    made = Path("build", "programs")
    made.mkdir(parents=True, exist_ok=True)
    for name in ("longarm", *NODES):
        text = f'#!/bin/sh\nexec "$(dirname "$(readlink -f "$0")")/../../bin/{name}" "$@"\n'
        (made / name).write_text(text)
        (made / name).chmod(0o755)
    return [(f"lib/{NAME}", [str(made / name) for name in ("longarm", *NODES)])]


setup(
    name=NAME,
    version=(ROOT / NAME / "version.py").read_text("utf-8").split('"')[-2],  # its only place
    description="Kinematics and error compensation of long, compliant robot arms, for ROS 2",
    long_description=(ROOT / "README.md").read_text("utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    classifiers=[
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Topic :: Scientific/Engineering",
    ],
    python_requires=">=3.10",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", *(f"**/*.{kind}" for kind in DATA_KINDS)]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", sorted(glob("config/*.yaml") + glob("config/*.rviz"))),
        (f"share/{NAME}/config/layouts", sorted(glob("config/layouts/*"))),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
        *programs(),
    ],
    install_requires=RUNTIME,
    extras_require=EXTRAS,
    zip_safe=False,
    entry_points={
        "console_scripts": [
            f"longarm = {NAME}.cli:main",
            *(f"{node} = {NAME}.nodes.{node}:main" for node in NODES),
        ]
    },
)
