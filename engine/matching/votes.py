"""Vote for a translation: find the matches between orthophoto and map that agree, among mostly wrong ones.

Every match votes for a position of the orthophoto. Right ones nearly agree, wrong ones scatter: the densest place
wins even if nine in ten are wrong. Small turns are tried as well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TURNS_DEG = (0.0, -6.0, 6.0)
"""Turns of an orthophoto to try, since a heading may be wrong."""
_RIVAL_RADII = 3.0  # from the best translation; closer votes may be its own, scattered by an unknown tilt


@dataclass(frozen=True, slots=True)
class Vote:
    """The translation that most matches agree on, and its votes.

    Attributes:
        turn_deg: of the orthophoto about its middle, from +x towards +y.
        voters: (M,) bool, the matches that agree.
        shift_px: (2,) from the orthophoto, turned, to the map.
        shifts_px: (M, 2) from each match of the turned orthophoto to the map.
        photo_px: (M, 2) the matches in the orthophoto.
        radius_px: a match this close to a translation agrees with it.
        distinct_px: matches nearer to each other in the orthophoto are one piece of evidence.
        chance: the probability that a wrong match agrees.
    """

    turn_deg: float
    voters: NDArray[np.bool_]
    shift_px: Array
    shifts_px: Array
    photo_px: Array
    radius_px: float
    distinct_px: float
    chance: float

    @property
    def tried(self) -> int:
        """How many translations were compared."""
        return len(self.photo_px) * len(TURNS_DEG)

    @property
    def surprise(self) -> float:
        """-log of the probability that as many wrong matches agree on one translation."""
        return self._surprise_of(self.voters)

    def rival_surprise(self, explained: NDArray[np.bool_]) -> float:
        """The same of the best translation elsewhere.

        Args:
            explained: (M,) bool, the matches that agree with the pose found from this vote. They are of its place,
                though a wrong tilt or height scatters their votes.
        """
        from engine.kernels import clusters  # numba takes a while to import

        apart = self.shifts_px - self.shift_px
        is_elsewhere = np.einsum("ij,ij->i", apart, apart) > (_RIVAL_RADII * self.radius_px) ** 2
        elsewhere = np.flatnonzero(is_elsewhere & ~explained)
        return self._surprise_of(elsewhere[clusters.densest(self.shifts_px[elsewhere], self.radius_px)])

    def _surprise_of(self, agreeing: NDArray[np.bool_] | NDArray[np.intp]) -> float:
        """-log of the probability that so many of all matches agree with one of them by chance.

        Of matches that see the same pixels one counts, among as many fewer in all.
        """
        from engine.kernels import clusters  # numba takes a while to import

        agreeing_px = self.photo_px[agreeing]
        votes = len(agreeing_px)
        if votes < 2:
            return 0.0
        distinct = int(clusters.count_apart(np.ascontiguousarray(agreeing_px), self.distinct_px))
        return distinct / votes * _binomial_surprise(len(self.photo_px) - 1, votes - 1, self.chance)


def vote(photo_px: Array, map_px: Array, radius_px: float, distinct_px: float) -> Vote | None:
    """The translation that most matches agree on.

    Args:
        photo_px: (M, 2) in the orthophoto, about its middle.
        map_px: (M, 2) on the map.
        radius_px: a match this close to a translation agrees with it.
        distinct_px: matches nearer to each other in the orthophoto are one piece of evidence.

    Returns:
        Vote | None: None without a match. The first of equals, so that a turn needs more votes than no turn.
    """
    from engine.kernels import clusters  # numba takes a while to import

    best: tuple[int, float, NDArray[np.bool_], Array] | None = None
    for turn_deg in TURNS_DEG:
        shifts = map_px - photo_px @ rotation(turn_deg).T
        voters = clusters.densest(shifts, radius_px)
        count = int(np.count_nonzero(voters))
        if count and (best is None or count > best[0]):
            best = (count, turn_deg, voters, shifts)
        if 2 * count > len(map_px):
            break  # a majority needs no further search
    if best is None:
        return None
    _, turn_deg, voters, shifts = best
    shift_px = shifts[voters].mean(axis=0)
    placed_px = photo_px @ rotation(turn_deg).T + shift_px
    extent = np.ptp(map_px - placed_px, axis=0) + 2.0 * radius_px
    by_chance = chance_of_agreeing(placed_px.T, map_px.T, voters, radius_px, float(extent.prod()))
    return Vote(turn_deg, voters, shift_px, shifts, photo_px, radius_px, distinct_px, by_chance)


def chance_of_agreeing(
    predicted_px: Array, seen_px: Array, agree: NDArray[np.bool_], radius_px: float, area_px2: float
) -> float:
    """The probability that a wrong match agrees with a pose.

    Where the pose predicts one match and where another is seen make a wrong match, but as crowded as right ones:
    it is the share of these that agree. A uniform density would not see crowds.

    Args:
        predicted_px: (2, N) pixels at which the pose predicts the matches.
        seen_px: (2, N) pixels at which they are.
        agree: (N,) which matches agree.
        radius_px: a match that is seen this close to its prediction agrees.
        area_px2: that wrong matches scatter over; no less chance is assumed than if they did so evenly.
    """
    from engine.kernels import clusters  # numba takes a while to import

    total = seen_px.shape[1]
    near = int(clusters.count_near_pairs(*map(np.ascontiguousarray, (*predicted_px, *seen_px)), radius_px))
    wrong = near - int(np.count_nonzero(agree))
    uniform = math.pi * radius_px * radius_px / area_px2
    share: float = wrong / (total * max(total - 1, 1))
    return min(max(share, uniform), 1.0)


def _binomial_surprise(n: int, k: int, p: float) -> float:
    """-log of the probability of k or more of n, by Hoeffding's bound."""
    q = k / n
    if q <= p:
        return 0.0
    return n * (q * math.log(q / p) + ((1.0 - q) * math.log((1.0 - q) / (1.0 - p)) if q < 1.0 else 0.0))


def rotation(turn_deg: float) -> Array:
    """(2, 2) matrix that turns from +x towards +y."""
    turn = math.radians(turn_deg)
    return np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
