"""Flight logs: one reader a format, and the resampling of their quantities to the moments of the frames."""
