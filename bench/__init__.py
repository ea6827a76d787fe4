"""Benchmarks: a speed is a ratio against a named peer, in one run, on one input, beside its accuracy."""
