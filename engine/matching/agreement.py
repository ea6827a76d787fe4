"""Agreement: whether two estimates of one place contradict each other."""

from __future__ import annotations

import numpy as np

from engine.geo import Array, chi_square, chi_square_of
from engine.values import SIGNIFICANCE, Fix


def are_consistent(apart_m: Array, covariance_m2: Array) -> bool:
    """Whether two estimates of one position agree.

    Args:
        apart_m: (2,) from one to the other, in metres.
        covariance_m2: (2, 2) sum of their covariances.

    Returns:
        bool: False if they contradict each other, see :data:`SIGNIFICANCE`.
    """
    return chi_square(apart_m, covariance_m2) <= chi_square_of(SIGNIFICANCE, 2)


def offset_between_m(first: Fix, second: Fix) -> Array:
    """How far one fix lies from another.

    Args:
        first: The fix at the offset's end.
        second: The fix at its start.

    Returns:
        (2,) metres east and north from the second fix to the first.
    """
    return np.array([first.east_m - second.east_m, first.north_m - second.north_m])


def agree_in_place(first: Fix, second: Fix) -> bool:
    """Whether two fixes on one map are of one place (:func:`are_consistent`); they share the map's error."""
    covariance_m2 = first.relative_covariance_m2 + second.relative_covariance_m2
    return are_consistent(offset_between_m(first, second), covariance_m2)


def are_near(first: Fix, second: Fix, exclusion_m: float) -> bool:
    """Whether two fixes lie within the distance at which a rival is the peak itself."""
    return float(np.hypot(*offset_between_m(first, second))) < exclusion_m


def agree_in_height(first: Fix, second: Fix) -> bool:
    """Whether two poses are equally high; the telemetry may hold refinement at a wrong height.

    Args:
        first: one pose; if it did not measure its height, it agrees with any.
        second: the other pose.
    """
    if first.up_m is None or second.up_m is None:
        return True
    variance_m2 = float(first.covariance_m2[2, 2] + second.covariance_m2[2, 2])
    variance_m2 -= first.map_sigma_m**2 + second.map_sigma_m**2  # they share this error
    return (first.up_m - second.up_m) ** 2 <= chi_square_of(SIGNIFICANCE, 1) * variance_m2
