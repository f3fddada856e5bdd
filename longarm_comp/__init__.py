"""Kinematics and error compensation of long, compliant robot arms.

One idea: every error of the arm is a small twist at one frame, and a model is a declared arm plus
a list of such effects. Importing this package imports nothing heavy.
"""

__version__ = "0.1.0"
