"""Whole runs: what each command does, as functions. Their public names are those of :mod:`scenematch`."""
