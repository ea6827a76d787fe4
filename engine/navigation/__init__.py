"""Navigation over a flight: carry the position from frame to frame and decide on each match."""
