"""The ROS 2 nodes. Each one converts messages, calls the core and publishes the result."""
