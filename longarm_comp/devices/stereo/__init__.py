"""Stereo measurement of a marker, without ROS: two images in, a point with covariance out."""
