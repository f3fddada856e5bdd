"""Stereo measurement of a marker, without ROS: two images in, a point with covariance out."""

from longarm_comp.devices.stereo.calibrate import (
    HandEye,
    StereoCalibration,
    calibrate_stereo,
    hand_eye,
)
from longarm_comp.devices.stereo.camera import Camera, StereoRig
from longarm_comp.devices.stereo.eye import StereoEye, StereoSighting
from longarm_comp.devices.stereo.found import Limits
from longarm_comp.devices.stereo.pairing import Drop, Pair, Side, StereoPairer
from longarm_comp.devices.stereo.refusal import RefusalReason, StereoRefusal
from longarm_comp.devices.stereo.target import CharucoTarget, Corners, TagBoard, Target
from longarm_comp.devices.stereo.triangulate import (
    PixelNoise,
    Triangulation,
    epipolar_px,
    triangulate,
)
