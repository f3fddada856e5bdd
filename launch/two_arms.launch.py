"""Two arms in two namespaces; each has the arguments of `longarm.launch.py` after its own name.

ros2 launch longarm_comp two_arms.launch.py left_arm_arm:=a.yaml right_arm_arm:=b.yaml sim:=true
"""

import runpy
from pathlib import Path

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from longarm_comp.share import folder

WHOLE = Path(__file__).with_name("longarm.launch.py")
STANDS = {"left_arm": "0 0 0 0 0 0", "right_arm": "0 -1 0 0 0 0"}
SHARED = (
    ("sim", "false", "simulated arms"),
    ("rviz", "false", "start RViz too, which shows both arms in the frame world"),
)


def view(context):
    """RViz, and where the arms stand in its world."""
    if LaunchConfiguration("rviz").perform(context).lower() not in ("true", "1"):
        return []
    made = [Node(package="rviz2", executable="rviz2",
                 arguments=["-d", str(folder("config") / "two_arms.rviz")])]  # fmt: skip
    for side in STANDS:
        place = LaunchConfiguration(f"{side}_at").perform(context)
        words = ["--frame-id", "world", "--child-frame-id", f"{side}/base"]
        names = ("x", "y", "z", "yaw", "pitch", "roll")
        for name, value in zip(names, place.split(), strict=True):
            words += [f"--{name}", value]
        made.append(
            Node(package="tf2_ros", executable="static_transform_publisher", name=f"{side}_stands",
                 arguments=words)
        )  # fmt: skip
    return made


def generate_launch_description():
    """`longarm.launch.py` once for each arm."""
    own = [
        (name, default, text)
        for name, default, text in runpy.run_path(str(WHOLE))["ARGUMENTS"]
        if name not in ("sim", "rviz", "namespace")
    ]
    made = [DeclareLaunchArgument(n, default_value=d, description=t) for n, d, t in SHARED]
    for side, place in STANDS.items():
        for name, default, text in own:
            made.append(
                DeclareLaunchArgument(f"{side}_{name}", default_value=default, description=text)
            )
        text = "where its base stands in RViz's world: x y z yaw pitch roll, m and rad"
        made.append(DeclareLaunchArgument(f"{side}_at", default_value=place, description=text))
        given = {name: LaunchConfiguration(f"{side}_{name}") for name, _, _ in own}
        given |= {"sim": LaunchConfiguration("sim"), "rviz": "false", "namespace": side}
        arm = IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(WHOLE)), launch_arguments=given.items()
        )
        made.append(GroupAction([arm], scoped=True))
    return LaunchDescription([*made, OpaqueFunction(function=view)])
