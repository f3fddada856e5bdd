"""Cameras and servo buses, without ROS."""
