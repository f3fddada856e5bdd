"""Inverse kinematics of the deflected arm, and the engines that run it."""
