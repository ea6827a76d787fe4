"""One flight: how a position is carried from frame to frame, and what is made of each answer."""
