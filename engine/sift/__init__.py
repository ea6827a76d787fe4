"""SIFT: compiled loops for the CPU, kornia's tensor ops for any device, and matching."""

BACKENDS = ("auto", "compiled", "kornia")
"""How features are found; "auto" takes the compiled loops on the CPU, else kornia."""
