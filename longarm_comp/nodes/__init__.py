"""The ROS 2 graph: one thin file a node. Declare, convert, call core, convert, publish."""
