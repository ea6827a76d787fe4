"""Bridges to autopilots and ROS: they translate messages and hold no algorithms."""
