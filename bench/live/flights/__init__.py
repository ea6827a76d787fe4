"""Flights of the bridge: a separate process beside the stand-in or SITL, with a camera that can fail."""
