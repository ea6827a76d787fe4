"""Scale space: all Gaussian levels of a batch of images, octave by octave, in one flat buffer.

Every level is ``G_y I G_x^T``; upsampling is part of G, so that no interpolation comes before the blur. As tensor
ops G is a banded matrix that is cut into blocks for the matmul; :func:`engine.sift.loops.filters` has the same
weights as a filter.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from engine.runtime.tensors import Tensor, torch

SCALES = 3  # DoG levels searched per octave, Lowe's s
_LEVELS = SCALES + 3  # Gaussian levels per octave
_CAMERA_SIGMA_PX = 0.5  # assumed blur of an image
FIRST_SIGMA_PX = 0.8  # sigma of the first Gaussian level, in pixels of the image
_TRUNCATE = 3.0  # a Gaussian's reach in sigmas
_BLOCK = 16  # input samples per block of a banded matrix
_MIN_OCTAVE = 12


@dataclass(frozen=True, slots=True)
class _Band:
    """Gaussian filters of all levels along one axis, cut into the blocks of a banded matrix."""

    blocks: Tensor  # (blocks, levels, outputs, inputs)
    reach: int  # inputs that a block takes on either side of its own

    @property
    def padded(self) -> int:
        return self.blocks.shape[0] * _BLOCK + 2 * self.reach


def reach_px(sigma: float) -> int:
    """Return the reach of a truncated Gaussian, in pixels of its input."""
    return math.ceil(_TRUNCATE * sigma)


@lru_cache(maxsize=4096)
def band(inputs: int, sigmas: tuple[float, ...], up: int, device: torch.device) -> _Band:
    """Return G[l, i, j] ~ exp(-(i / up - j)^2 / (2 sigma_l^2)), rows summing to 1 also at the edges."""
    outputs = _outputs(inputs, up)
    reach = reach_px(max(sigmas)) + up - 1
    rows = _BLOCK * up
    count = math.ceil(outputs / rows)
    out, source = np.arange(rows)[:, None], np.arange(-reach, _BLOCK + reach)  # of the first block
    spread = np.maximum(np.array(sigmas), 1e-3).reshape(-1, 1, 1)
    near = np.array([reach_px(s) for s in sigmas]).reshape(-1, 1, 1)
    shape = np.exp(-0.5 * ((out / up - source) / spread) ** 2)  # (levels, rows, inputs), the same in every block
    shape *= (source - out // up >= -near) & (source - out // up < near + up)
    block = np.arange(count).reshape(-1, 1, 1, 1)
    inside = (source + block * _BLOCK >= 0) & (source + block * _BLOCK < inputs) & (out + block * rows < outputs)
    weights = shape * inside
    weights /= np.maximum(weights.sum(-1, keepdims=True), 1e-30)
    return _Band(torch.from_numpy(weights.astype(np.float32)).to(device), reach)


def _outputs(inputs: int, up: int) -> int:
    return (inputs - 1) * up + 1


@dataclass(frozen=True, slots=True)
class Octave:
    """Layout of an octave in the flat buffer of Gaussians: levels x rows x images x columns."""

    source: tuple[int, int]  # height and width of the picture that is blurred
    up: int  # outputs per pixel of it
    sigmas: tuple[float, ...]  # in its pixels
    height: int
    width: int
    shape: tuple[int, int, int, int]  # with the blocks' padding
    offset: int

    @property
    def layout(self) -> tuple[int, int, int, int, int]:
        """Height, width, offset, and the strides of level and row."""
        return self.height, self.width, self.offset, self.per_level, math.prod(self.shape[2:])

    @property
    def per_level(self) -> int:
        """Stride of a level."""
        return math.prod(self.shape[1:])

    @property
    def end(self) -> int:
        """Where its part of the buffer ends."""
        return self.offset + math.prod(self.shape)

    def levels(self, gaussians: Tensor) -> Tensor:
        """Return the octave's part of the buffer.

        Args:
            gaussians: (N,) the buffer.

        Returns:
            (levels, rows, images, columns), a view.
        """
        return gaussians[self.offset : self.end].view(self.shape)


@dataclass(frozen=True, slots=True)
class ScaleSpacePlan:
    """Layout of a scale space, which depends on the images' shape alone."""

    upsample: int
    octaves: tuple[Octave, ...]
    gaussian_size: int
    table: Tensor  # (octaves, 6) int64: height, width, offset, and the strides of level, row and image

    @property
    def index(self) -> torch.dtype:
        """The integer that holds every index of the buffer; the shorter one gathers faster."""
        return torch.int32 if self.gaussian_size < 2**31 else torch.int64

    @property
    def first_sigma(self) -> float:
        """Sigma of each octave's first level in pixels of the octave."""
        return FIRST_SIGMA_PX * self.upsample


def octaves_of(height: int, width: int, batch: int, upsample: int) -> tuple[Octave, ...]:
    """Lay out the octaves of a batch of pictures, one after the other.

    Args:
        height: of the pictures.
        width: of the pictures.
        batch: how many.
        upsample: samples per pixel of the first octave.
    """
    growth = [2.0 ** (level / SCALES) for level in range(_LEVELS)]
    sigmas = tuple(math.sqrt((FIRST_SIGMA_PX * g) ** 2 - _CAMERA_SIGMA_PX**2) for g in growth)
    octaves: list[Octave] = []
    offset, source, up = 0, (height, width), upsample
    while not octaves or min(source) >= _MIN_OCTAVE:
        height, width = (_outputs(n, up) for n in source)
        rows, columns = (-(-n // (_BLOCK * up)) * _BLOCK * up for n in (height, width))
        octaves.append(Octave(source, up, sigmas, height, width, (_LEVELS, rows, batch, columns), offset))
        offset = octaves[-1].end
        sigmas = tuple(FIRST_SIGMA_PX * upsample * math.sqrt(g**2 - 1) for g in growth)
        source, up = ((height + 1) // 2, (width + 1) // 2), 1
    return tuple(octaves)


@lru_cache(maxsize=256)
def make_plan(height: int, width: int, batch: int, upsample: int, device: torch.device) -> ScaleSpacePlan:
    """Lay out the scale space of tensor ops; cached for the most recent shapes, as frames come in few sizes."""
    octaves = octaves_of(height, width, batch, upsample)
    table = [(*octave.layout, octave.shape[3]) for octave in octaves]
    return ScaleSpacePlan(upsample, octaves, octaves[-1].end, torch.tensor(table).to(device))


def gaussian_levels(images: Tensor, plan: ScaleSpacePlan) -> Tensor:
    """Return all Gaussian levels of all octaves.

    Args:
        images: (B, H, W) float32.
        plan: of these images.

    Returns:
        (N,) float32, laid out by the plan.
    """
    gaussians = images.new_empty(plan.gaussian_size)
    for octave in plan.octaves:
        images = _blur(images, octave, gaussians)[SCALES, :, ::2, ::2]
    return gaussians


def _blur(images: Tensor, octave: Octave, gaussians: Tensor) -> Tensor:
    """Write the octave's levels G_y I G_x^T into their place and return them as (L, B, height, width)."""
    batch, height, width = images.shape
    across, down = (band(n, octave.sigmas, octave.up, images.device) for n in (width, height))
    count, levels, size, _ = across.blocks.shape
    wide = images.new_zeros(height, batch, across.padded)
    wide[..., across.reach : across.reach + width] = images.transpose(0, 1)
    across_windows = wide.view(height * batch, -1).unfold(1, _BLOCK + 2 * across.reach, _BLOCK).transpose(0, 1)
    tall = images.new_zeros(down.padded, batch, count, size)
    inner = tall[down.reach : down.reach + height]
    down_windows = tall.flatten(1).unfold(0, _BLOCK + 2 * down.reach, _BLOCK).transpose(1, 2)
    out = octave.levels(gaussians)
    for level in range(levels):
        rows = torch.bmm(across_windows, across.blocks[:, level].mT)
        inner.copy_(rows.view(count, height, batch, size).permute(1, 2, 0, 3))
        torch.bmm(
            down.blocks[:, level], down_windows, out=out[level].view(len(down_windows), -1, batch * count * size)
        )
    return out.transpose(1, 2)[..., : octave.height, : octave.width]
