"""Emulated servo buses on a pseudo-terminal. They share no code with the real driver."""

from longarm_comp.sim.servo_emulator.emulator import LoadOf, ServoEmulator, WireFaults
from longarm_comp.sim.servo_emulator.joints import EmulatedArm, EmulatedJoint, read_arm
from longarm_comp.sim.servo_emulator.motor import Motor, MotorSpec
