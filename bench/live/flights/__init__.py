"""Flights with faults: run the bridge as a separate process beside the stand-in, with a camera that can fail."""
