"""Geodesy: WGS84, a local east-north-up frame, rotations, and the propagation of covariance.

Convention:
    East, north and up are metres in the plane tangent to the ellipsoid at a stated origin.
    Rotations are written ``to_from``: ``enu_from_body @ v_body`` is the same vector in east-north-up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from pyproj import Transformer

Array = NDArray[np.float64]
Angles = TypeVar("Angles", float, Array)

_SINGULAR = 1e-12  # determinant over that of the diagonal; below it rounding dominates


@dataclass(frozen=True)
class LocalFrame:
    """East-north-up about an origin on the ellipsoid.

    Attributes:
        lat_deg: latitude of the origin.
        lon_deg: longitude of the origin.
    """

    lat_deg: float
    lon_deg: float

    @cached_property
    def _topocentric(self) -> Transformer:
        """PROJ's transform of longitude, latitude and height above the ellipsoid to east, north and up."""
        from pyproj import Transformer  # takes a while to import

        return Transformer.from_pipeline(
            "+proj=pipeline +ellps=WGS84 +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart "
            f"+step +proj=topocentric +lat_0={float(self.lat_deg)!r} +lon_0={float(self.lon_deg)!r}"
        )

    def enu_from_geodetic(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> Array:
        """Local coordinates of points on the ellipsoid.

        Args:
            lat_deg: (...,) WGS84 latitude.
            lon_deg: (...,) WGS84 longitude.

        Returns:
            (..., 2) east and north in metres.
        """
        lat, lon = np.broadcast_arrays(np.asarray(lat_deg, float), np.asarray(lon_deg, float))
        return np.stack(self._topocentric.transform(lon, lat, np.zeros_like(lat))[:2], axis=-1)

    def convergence_deg(self, lat_deg: float, lon_deg: float) -> float:
        """Direction of true north at a position, clockwise from this frame's north, in [-180, 180].

        A heading in these axes is the true heading plus this. It is 0 at the origin; elsewhere it is about the
        longitude difference times the negative sine of latitude.

        Args:
            lat_deg: of the position.
            lon_deg: of the position.

        Returns:
            Degrees.
        """
        lat, lon = math.radians(lat_deg), math.radians(lon_deg - self.lon_deg)
        origin_lat = math.radians(self.lat_deg)
        east = -math.sin(lat) * math.sin(lon)
        north = math.sin(origin_lat) * math.sin(lat) * math.cos(lon) + math.cos(origin_lat) * math.cos(lat)
        return math.degrees(math.atan2(east, north))

    def geodetic_from_enu(self, east_m: ArrayLike, north_m: ArrayLike) -> tuple[Array, Array]:
        """Geodetic coordinates of the points on the ellipsoid below local ones.

        Args:
            east_m: (...,).
            north_m: (...,).

        Returns:
            WGS84 latitude and longitude in degrees, (...,) each.
        """
        east, north = np.broadcast_arrays(np.asarray(east_m, float), np.asarray(north_m, float))
        # The ellipsoid is below the tangent plane by d^2 / 2R; two rounds find that drop.
        drop = np.zeros_like(east)
        for _ in range(3):
            lon, lat, height = self._topocentric.transform(east, north, -drop, direction="INVERSE")
            drop = drop + height
        return np.asarray(lat), np.asarray(lon)


def enu_from_body(roll_deg: float, pitch_deg: float, heading_deg: float) -> Array:
    """Rotation from body (forward-right-down) to east-north-up.

    Convention:
        Aerospace order: heading about down, then pitch about right, then roll about forward.

    Args:
        roll_deg: positive right side down.
        pitch_deg: positive nose up.
        heading_deg: clockwise from true north.

    Returns:
        (3, 3), ``v_enu = enu_from_body(...) @ v_body``.
    """
    sr, sp, sh = (math.sin(math.radians(v)) for v in (roll_deg, pitch_deg, heading_deg))
    cr, cp, ch = (math.cos(math.radians(v)) for v in (roll_deg, pitch_deg, heading_deg))
    # Rz(heading) Ry(pitch) Rx(roll) takes the body to north-east-down; its rows as east, north and -down.
    return np.array(
        [
            [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
            [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
            [sp, -cp * sr, -cp * cr],
        ]
    )


def attitude_from_rotation(enu_from_body_: Array) -> tuple[float, float, float]:
    """Roll, pitch and heading of a rotation; the inverse of :func:`enu_from_body`.

    Args:
        enu_from_body_: (3, 3). At a pitch of +-90 degrees roll and heading are not separable.

    Returns:
        Roll, pitch and heading in degrees, the heading in [0, 360).
    """
    forward, right, down = (enu_from_body_[:, i] for i in range(3))
    heading = wrap_heading_deg(math.degrees(math.atan2(forward[0], forward[1])))
    pitch = math.degrees(math.asin(float(np.clip(forward[2], -1.0, 1.0))))
    roll = math.degrees(math.atan2(-right[2], -down[2]))
    return roll, pitch, heading


def angle_covariance_deg2(turn_covariance_rad2: Array, roll_deg: float, pitch_deg: float) -> Array:
    """Covariance of roll, pitch and heading from that of a small turn about the body's axes.

    Args:
        turn_covariance_rad2: (3, 3) about forward, right and down.
        roll_deg: of the body.
        pitch_deg: of the body; near +-90 degrees roll and heading are not separable, and their variances grow.

    Returns:
        (3, 3) in square degrees.
    """
    by_turn = np.asarray(np.linalg.inv(_turn_by_angles(roll_deg, pitch_deg)), np.float64)
    return transport_covariance(math.degrees(1.0) * by_turn, turn_covariance_rad2)


def enu_turn_covariance_rad2(angle_covariance: Array, angles_deg: tuple[float, float, float]) -> Array:
    """Covariance of a small turn about east, north and up from that of roll, pitch and heading.

    Args:
        angle_covariance: (3, 3) in square degrees.
        angles_deg: roll, pitch and heading of the body.

    Returns:
        (3, 3) in rad^2.
    """
    turn_by_angles = enu_from_body(*angles_deg) @ _turn_by_angles(*angles_deg[:2])
    return transport_covariance(math.radians(1.0) * turn_by_angles, angle_covariance)


def _turn_by_angles(roll_deg: float, pitch_deg: float) -> Array:
    """(3, 3) turn about the body's axes by a small change of roll, pitch and heading."""
    sr, cr = math.sin(math.radians(roll_deg)), math.cos(math.radians(roll_deg))
    sp, cp = math.sin(math.radians(pitch_deg)), max(math.cos(math.radians(pitch_deg)), 1e-6)
    return np.array([[1.0, 0.0, -sp], [0.0, cr, sr * cp], [0.0, -sr, cr * cp]])


def wrap_heading_deg(heading_deg: float) -> float:
    """Wrap to [0, 360); twice, since the remainder of a tiny negative angle rounds to 360."""
    return heading_deg % 360.0 % 360.0


def wrap_difference_deg(difference_deg: Angles) -> Angles:
    """Wrap to [-180, 180)."""
    return (difference_deg + 180.0) % 360.0 - 180.0


def larger_variance(covariance: Array) -> float:
    """Variance along the longer axis of the ellipse.

    Args:
        covariance: (2, 2).

    Returns:
        The larger of its eigenvalues.
    """
    (a, b), (_, d) = covariance.tolist()  # some twenty times as fast as NumPy's solver
    return float(0.5 * (a + d) + math.hypot(0.5 * (a - d), b))


def chi_square(difference: Array, covariance: Array) -> float:
    """Squared Mahalanobis length of a difference, chi-square with two degrees of freedom.

    Args:
        difference: (2,).
        covariance: (2, 2) of the difference, positive semidefinite.

    Returns:
        0 or more; infinite for a difference along a direction in which the covariance is zero.
    """
    (a, b), (c, d) = covariance.tolist()  # ten times as fast as NumPy's solver
    x, y = difference.tolist()
    across, determinant = d * x * x - (b + c) * x * y + a * y * y, a * d - b * c
    if determinant <= _SINGULAR * a * d:  # only a difference along its one direction, if any, is finite
        allowed, squared = a + d, x * x + y * y
        if across > _SINGULAR * allowed * squared or squared > 0.0 >= allowed:
            return math.inf
        return float(squared / allowed) if allowed > 0.0 else 0.0
    return float(across / determinant)


def chi_square_of(probability: float, degrees: int) -> float:
    """The chi-square that chance exceeds with a probability, for one or two degrees of freedom."""
    if degrees == 1:
        return NormalDist().inv_cdf(1.0 - probability / 2.0) ** 2
    return -2.0 * math.log(probability)


def inverse_2x2(matrix: Array) -> Array:
    """The inverse of a 2 x 2 matrix, ten times as fast as NumPy's.

    Args:
        matrix: (2, 2) with a non-zero determinant.

    Returns:
        (2, 2).
    """
    (a, b), (c, d) = matrix.tolist()
    return np.asarray(np.array([[d, -b], [-c, a]]) / (a * d - b * c), np.float64)


def transport_covariance(jacobian: Array, covariance: Array) -> Array:
    """First-order covariance of f(x): J C J^T, symmetrised against rounding.

    Args:
        jacobian: (M, N) of f by x.
        covariance: (N, N) of x.

    Returns:
        (M, M).
    """
    propagated = jacobian @ covariance @ jacobian.T
    return np.asarray(0.5 * (propagated + propagated.T), dtype=np.float64)
