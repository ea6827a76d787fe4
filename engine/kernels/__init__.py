"""Kernels: tensor ops and compiled loops for NCC behind :mod:`engine.ncc_fft`; compiled loops for the rest.

Loops compiled by numba (SIFT from picture to votes, dense refinement, surfaces and the georeference of maps) are
imported where they are called, since numba takes a while to import.

Tests compare NCC with equation 1 and SIFT with the paper, both written out in float64, the other loops with
OpenCV, NumPy and difference quotients.
"""
