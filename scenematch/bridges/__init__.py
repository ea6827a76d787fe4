"""Bridges to autopilots and ROS: they translate messages and contain no algorithms."""
