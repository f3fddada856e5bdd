"""Reading and writing of sessions (CSV, ROS bags), pose plans, targets and commands."""
