"""Flights with faults: the bridge as a process of its own beside the stand-in, with a camera that can fail."""
