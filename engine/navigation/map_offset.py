"""The map's own error: its offset from positions of another source, estimated in flight."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from engine.geo import LocalFrame
from engine.navigation.motion import PositionEstimate, en_m
from engine.values import Fix

Array = NDArray[np.float64]

_SOURCE_S = 60.0  # how long an error of the other source lasts; satellite navigation wanders over minutes


@dataclass(frozen=True, slots=True)
class MapOffset:
    """The offset to add to a position on the map to agree with the other source.

    Attributes:
        en_m: (2,) east and north.
        covariance_m2: (2, 2) of the offset.
    """

    en_m: Array
    covariance_m2: Array

    def corrected(self, fix: Fix, frame: LocalFrame) -> Fix:
        """A fix moved by the offset; only the offset's uncertainty remains of the map's error.

        Args:
            fix: of the same map.
            frame: of the map.

        Returns:
            Fix: ``map_xy_px`` stays at the place that the map shows.
        """
        east, north = en_m(fix) + self.en_m
        lat, lon = frame.geodetic_from_enu(east, north)
        covariance = fix.covariance_m2.copy()
        covariance[:2, :2] = fix.relative_covariance_m2 + self.covariance_m2
        return replace(
            fix,
            lat_deg=float(lat),
            lon_deg=float(lon),
            east_m=float(east),
            north_m=float(north),
            covariance_m2=covariance,
            map_sigma_m=0.0,
        )


class MapOffsetEstimator:
    """Averages the differences between fixes and the positions of another source.

    The offset is a single error of the map, with the standard deviation that the fixes state. An error of the
    other source lasts for about a minute, so a minute of differences counts as one.
    """

    def __init__(self) -> None:
        self._mean, self._precision = np.zeros(2), np.zeros((2, 2))
        self._time_s: float | None = None

    @property
    def offset(self) -> MapOffset | None:
        """The estimate; None before the first difference, or if the map has no error."""
        if self._time_s is None:
            return None
        return MapOffset(self._mean.copy(), np.asarray(np.linalg.inv(self._precision), np.float64))

    def add(self, fix: Fix, given: PositionEstimate, time_s: float) -> None:
        """Add a fix and the other source's position at that time.

        Args:
            fix: an accepted fix.
            given: the other source's position.
            time_s: of both; ignored unless later than the last one.
        """
        if fix.map_sigma_m <= 0.0 or (self._time_s is not None and time_s <= self._time_s):
            return
        share = 1.0
        if self._time_s is None:
            self._precision = np.eye(2) / fix.map_sigma_m**2
        else:
            share = -math.expm1(-(time_s - self._time_s) / _SOURCE_S)
        self._time_s = time_s
        gained = share * np.linalg.inv(fix.relative_covariance_m2 + given.sigma_m**2 * np.eye(2))
        precision = self._precision + gained
        difference = given.en_m - en_m(fix)
        weighted = self._precision @ self._mean + gained @ difference
        self._mean = np.asarray(np.linalg.solve(precision, weighted), np.float64)
        self._precision = precision
