"""The demonstration arm, simulated: `ros2 launch longarm_comp simulation.launch.py rviz:=true`."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from longarm_comp.share import folder

ARGUMENTS = (
    ("arm", str(folder("config") / "arm_demo.yaml"), "arm.yaml: the declared arm"),
    ("hidden", "joint_compliance=3.0", "undeclared effects and their size at the tip, mm"),
    ("speed", "1.0", "motion so many times faster"),
    ("namespace", "", "of this arm"),
    ("rviz", "false", "start RViz too"),
)


def generate_launch_description():
    """`longarm.launch.py` with the simulated arm."""
    own = [DeclareLaunchArgument(n, default_value=d, description=t) for n, d, t in ARGUMENTS]
    passed = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    whole = PythonLaunchDescriptionSource(str(Path(__file__).with_name("longarm.launch.py")))
    return LaunchDescription(
        [*own, IncludeLaunchDescription(whole, launch_arguments={**passed, "sim": "true"}.items())]
    )
