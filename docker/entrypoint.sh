#!/bin/bash
# ROS, the interfaces of this package, then the command.
set -e
. /opt/ros/jazzy/setup.bash
. /ws/install/setup.bash
exec "$@"
