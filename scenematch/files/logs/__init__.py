"""Flight logs: one reader per format, and resampling to the times of the frames."""
