"""Sessions in and out: CSV files and ROS bags, and the targets and commands beside them."""
