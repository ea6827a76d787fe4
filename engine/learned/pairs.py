"""The interface of image matchers, for options that name one; needs no network and no torch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from engine.runtime.tensors import Tensor


class PairMatcher(Protocol):
    """Finds the points that two pictures share."""

    def __call__(self, frame: Tensor, crop: Tensor) -> tuple[Tensor, Tensor]:
        """Match two pictures.

        Args:
            frame: (1, 1, H, W) float, values in [0, 1].
            crop: (1, 1, H', W') likewise, of the map.

        Returns:
            The matched points, (M, 2) in the frame's pixels and (M, 2) in the crop's, both (x, y) with centres
            at integers. Rows correspond; M may be 0.
        """
        ...
