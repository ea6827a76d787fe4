"""Scale space: Lowe's numbers, and the layout of a picture's Gaussian levels in one flat buffer."""

import math
from dataclasses import dataclass
from functools import lru_cache

SCALES = 3  # DoG levels searched per octave, Lowe's s
FIRST_SIGMA_PX = 0.8  # sigma of the first Gaussian level, in pixels of the image
TRUNCATE = 3.0  # a Gaussian's reach in sigmas
EDGE_RATIO = 10.0  # ratio of a keypoint's curvatures at which it lies on an edge
_CAMERA_SIGMA_PX = 0.5  # assumed blur of an image
_MIN_OCTAVE = 12  # least side of an octave


@dataclass(frozen=True, slots=True)
class Octave:
    """Layout of an octave in the flat buffer of Gaussians: levels x rows x columns."""

    source: tuple[int, int]  # height and width of the picture that is blurred
    up: int  # outputs per pixel of it
    sigmas: tuple[float, ...]  # in its pixels
    height: int
    width: int
    offset: int

    @property
    def layout(self) -> tuple[int, int, int, int, int]:
        """Height, width, offset, and the strides of level and row."""
        return self.height, self.width, self.offset, self.per_level, self.width

    @property
    def per_level(self) -> int:
        """Stride of a level."""
        return self.height * self.width

    @property
    def end(self) -> int:
        """Where its part of the buffer ends."""
        return self.offset + len(self.sigmas) * self.per_level


@lru_cache(maxsize=256)
def octaves_of(height: int, width: int, upsample: int) -> tuple[Octave, ...]:
    """Lay out the octaves of a picture, one after the other.

    Args:
        height: of the picture.
        width: of the picture.
        upsample: samples per pixel of the first octave.
    """
    # Extrema are searched in differences of levels with one on either side.
    growth = [2.0 ** (level / SCALES) for level in range(SCALES + 3)]
    sigmas = tuple(math.sqrt((FIRST_SIGMA_PX * g) ** 2 - _CAMERA_SIGMA_PX**2) for g in growth)
    octaves: list[Octave] = []
    offset, source, up = 0, (height, width), upsample
    while not octaves or min(source) >= _MIN_OCTAVE:
        height, width = ((n - 1) * up + 1 for n in source)
        octaves.append(Octave(source, up, sigmas, height, width, offset))
        offset = octaves[-1].end
        sigmas = tuple(FIRST_SIGMA_PX * upsample * math.sqrt(g**2 - 1) for g in growth)
        source, up = ((height + 1) // 2, (width + 1) // 2), 1
    return tuple(octaves)
