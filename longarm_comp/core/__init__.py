"""Arm physics, compensation, learning and identification: pure Python, no ROS."""
