"""Pixels and bytes: cameras and servo buses, without ROS."""
