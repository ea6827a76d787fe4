"""Kernels: tensor ops and compiled loops for NCC behind :mod:`engine.ncc_fft`; compiled loops for the rest.

Tests compare every kernel of NCC with :mod:`engine.kernels.reference`, which is slow, float64 and obvious.

Loops compiled by numba (SIFT from picture to votes, dense refinement, surfaces and the georeference of maps) are
imported where they are called, since numba takes a while to import. Tests compare SIFT's with the paper written
out in float64, the others with OpenCV, NumPy and difference quotients.
"""
