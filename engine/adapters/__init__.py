"""Bridges to autopilots and robots: they translate, and hold no algorithms."""
