"""Two arms in two namespaces: every name of the graph is relative, so nothing else is needed."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

SIDES = ("left_arm", "right_arm")


def generate_launch_description():
    """`longarm.launch.py` once for each arm."""
    whole = PythonLaunchDescriptionSource(str(Path(__file__).with_name("longarm.launch.py")))
    made = [DeclareLaunchArgument("sim", default_value="false", description="simulated arms")]
    for side in SIDES:
        made += [
            DeclareLaunchArgument(f"{side}_arm", description=f"arm.yaml of {side}"),
            DeclareLaunchArgument(f"{side}_port", default_value="", description="its servo bus"),
            DeclareLaunchArgument(f"{side}_model", default_value="", description="its model.yaml"),
        ]
        given = {
            "arm": LaunchConfiguration(f"{side}_arm"),
            "port": LaunchConfiguration(f"{side}_port"),
            "model": LaunchConfiguration(f"{side}_model"),
            "sim": LaunchConfiguration("sim"),
            "namespace": side,
        }
        arm = IncludeLaunchDescription(whole, launch_arguments=given.items())
        made.append(GroupAction([arm], scoped=True))
    return LaunchDescription(made)
