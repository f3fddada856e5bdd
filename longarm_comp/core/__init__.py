"""Arm physics, compensation, learning and identification: pure Python, no ROS.

Modules import only modules above them in this order: twist (spatial), arm, posture, effects, model,
ik, compensate, dataset, learn, identify. ``errors`` and ``files`` stand above all of them.
"""
