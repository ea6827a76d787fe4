"""Complete runs: one function for each command, exported by :mod:`scenematch`."""
