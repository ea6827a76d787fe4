"""Local features as tensor ops: a batched SIFT that detects, describes and matches on any torch device.

The detector is Lowe's: extrema of differences of Gaussians over position and scale, refined by a quadratic.
The descriptor is Lowe's 4 x 4 cells of 8 orientations. Three things differ from the usual loops, and
keep the work a fixed number of tensor ops however many keypoints there are:

- every Gaussian level is ``G_y I G_x^T``, with banded matrices that are cut into blocks for the matmul;
  upsampling is part of the matrix, so that no interpolation comes before the blur;
- the descriptor samples a rotated grid around the keypoint, and its spatial pooling is one matmul;
- the split of a gradient between its two neighbouring orientations needs no arc tangent (:func:`_orient`).

Convention:
    Points are (x, y) with pixel centres at integers and the origin at the centre of the top-left pixel.
    Angles turn from +x towards +y, which is clockwise on the screen. ``scale_px`` is Lowe's: the sigma of the
    finer of the two Gaussians whose difference is extremal; a Gaussian blob of sigma b gives about b / 2^(1/6).

References:
    Lowe, Distinctive image features from scale-invariant keypoints, IJCV 2004,
    https://doi.org/10.1023/B:VISI.0000029664.99615.94.
    Arandjelovic and Zisserman, Three things everyone should know to improve object retrieval, CVPR 2012,
    https://doi.org/10.1109/CVPR.2012.6248018 (RootSIFT).
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from engine.errors import DtypeError, OptionError, ShapeError

_SCALES = 3  # DoG levels searched per octave, Lowe's s
_LEVELS = _SCALES + 3  # Gaussian levels per octave
_CAMERA_SIGMA_PX = 0.5  # blur that an image is taken to have
_FIRST_SIGMA_PX = 0.8  # sigma of the first Gaussian level, in pixels of the image
_TRUNCATE = 3.0  # a Gaussian's reach in sigmas
_BLOCK = 16  # input samples per block of a banded matrix
_BORDER = 4  # octave pixels along the edge that carry no keypoint
_SMALLEST_OCTAVE = 12
_EDGE_RATIO = 10.0
_EARLY = 0.8  # share of the contrast threshold that a voxel must reach before it is refined
_STRIP = 100_000  # pixels of a level that the search for extrema takes at a time on a CPU
_MOVES = 2  # times that a keypoint may move to a neighbouring voxel
_FARTHEST = 0.7  # distance from the last voxel, in voxels, beyond which a refinement has not converged
_ANGLE_BINS = 36
_ORIENT_SAMPLES = 13  # per side, 0.75 sigma apart: Lowe's window of 4.5 sigma
_ORIENT_STEP = 0.75
_CELLS = 4
_CELL_SIGMAS = 3.0
_CELL_SAMPLES = 3
_DESC_SAMPLES = 12


@dataclass(frozen=True, slots=True)
class Features:
    """Keypoints and descriptors of a batch of images, in slots of fixed number.

    A slot that holds no keypoint is False in ``valid`` and zero elsewhere. The first slots hold the keypoints
    within their cell's share (see :func:`sift`), the next those beyond it, both by falling contrast.

    Attributes:
        xy_px: (B, N, 2) positions (x, y), pixel centres at integers.
        scale_px: (B, N) sigma of the keypoint in pixels of the image.
        angle_deg: (B, N) in [0, 360), from +x towards +y (clockwise on the screen).
        descriptors: (B, N, 128) of unit L2 norm; 4 x 4 cells row by row, 8 orientations each.
        valid: (B, N) bool.
    """

    xy_px: Tensor
    scale_px: Tensor
    angle_deg: Tensor
    descriptors: Tensor
    valid: Tensor

    def lafs(self, magnification: float = 6.0) -> Tensor:
        """Return kornia's local affine frames, (B, N, 2, 3).

        Args:
            magnification: Half the side of the described square in sigmas; kornia's SIFT takes 6.

        Convention:
            The first two columns are the images of the patch's x and y axes, the third is the centre.
            kornia's own angles turn the other way, so ``kornia.feature.get_laf_orientation`` gives -angle_deg.
        """
        angle = torch.deg2rad(self.angle_deg)
        cos, sin = (magnification * self.scale_px * f for f in (angle.cos(), angle.sin()))
        axes = torch.stack([cos, -sin, sin, cos], dim=-1).unflatten(-1, (2, 2))
        return torch.cat([axes, self.xy_px.unsqueeze(-1)], dim=-1)


def sift(
    images: Tensor,
    *,
    max_keypoints: int = 300,
    upright: bool = False,
    mask: Tensor | None = None,
    upsample: float = 2.0,
    contrast_threshold: float = 0.02,
    root: bool = True,
    spread: int = 6,
) -> Features:
    """Detect and describe at most ``max_keypoints`` SIFT features per image, spread over the image.

    Args:
        images: (B, 1, H, W) floating point, values in [0, 1].
        max_keypoints: Number of slots N.
        upright: Take every angle as 0 instead of the dominant gradient's; right where the heading is known.
        mask: (B, 1, H, W) bool, True where a keypoint may lie.
        upsample: Grid of the first octave, in samples per image pixel: 1, 1.5 or 2. The scales are the same.
        contrast_threshold: Lowe's, as OpenCV counts it: a keypoint's DoG is at least a third of it.
        root: Return RootSIFT (square roots of the L1-normalised descriptor), also of unit L2 norm.
        spread: The image is divided into spread x spread cells, and keypoints beyond a cell's double share give
            way to weaker ones elsewhere; 1 ranks by contrast alone.

    Returns:
        Features on the images' device; no value is NaN.
    """
    _check_images(images, mask)
    _check_options(max_keypoints, upsample, contrast_threshold, spread)
    with torch.inference_mode():
        batch, _, height, width = images.shape
        plan = _plan(height, width, batch, upsample, images.device)
        gaussians = _scale_space(images[:, 0].float().nan_to_num(0.0, 1.0, 0.0), plan)
        points = _detect(gaussians, plan, contrast_threshold)
        if mask is not None:
            points = points.take(_allowed(points, mask))
        points = points.take(_strongest(points, plan, max_keypoints, spread))
        angle = torch.zeros_like(points.x) if upright else _dominant_angle(gaussians, points, plan)
        descriptors = _describe(gaussians, points, angle, plan, root=root)
        return _to_slots(points, angle, descriptors, batch, max_keypoints)


def opencv_sift(
    images: np.ndarray, *, max_keypoints: int = 300, contrast_threshold: float = 0.04, root: bool = False
) -> Features:
    """Detect and describe with ``cv2.SIFT``, the plain recipe's detector.

    Positions carry OpenCV's bias of +0.25 px in x and y that comes from its upsampling.

    Args:
        images: (H, W) or (B, H, W) uint8.
        max_keypoints: Number of slots N. OpenCV counts each orientation of a place as a keypoint.
        contrast_threshold: As in :func:`sift`.
        root: Return RootSIFT instead of the L2-normalised descriptor.

    Returns:
        Features on the CPU.
    """
    import cv2

    if images.ndim not in (2, 3):
        raise ShapeError(f"images: expected (H, W) or (B, H, W), got {images.shape}")
    if images.dtype != np.uint8:
        raise DtypeError(f"images: expected uint8, got {images.dtype}")
    _check_options(max_keypoints, 2.0, contrast_threshold, 1)
    batch = images if images.ndim == 3 else images[None]
    detector = cv2.SIFT_create(nfeatures=max_keypoints, contrastThreshold=contrast_threshold)
    slots = np.zeros((len(batch), max_keypoints, 4 + 128), np.float32)
    valid = np.zeros((len(batch), max_keypoints), bool)
    for b, image in enumerate(batch):
        keypoints, descriptors = detector.detectAndCompute(image, None)
        count = min(len(keypoints), max_keypoints)
        if count:
            slots[b, :count, :4] = [(*k.pt, k.size / 2, k.angle % 360) for k in keypoints[:count]]
            slots[b, :count, 4:] = descriptors[:count]
            valid[b, :count] = True
    values = torch.from_numpy(slots)
    described = _normalise(values[..., 4:], root=root)
    return Features(values[..., :2], values[..., 2], values[..., 3], described, torch.from_numpy(valid))


@dataclass(frozen=True, slots=True)
class Matches:
    """For every query slot its nearest train slot, and whether it passed the tests.

    Attributes:
        train_index: (B, N) int64.
        distance: (B, N) Euclidean distance of the descriptors, in [0, 2]; infinite where none was allowed.
        ratio: (B, N) distance over the second nearest's, in [0, 1]; 0 where there is no second.
        valid: (B, N) bool.
    """

    train_index: Tensor
    distance: Tensor
    ratio: Tensor
    valid: Tensor

    def pairs(self, element: int = 0) -> Tensor:
        """Return (M, 2) int64, the accepted (query, train) slots of one element of the batch."""
        query = self.valid[element].nonzero()[:, 0]
        return torch.stack([query, self.train_index[element, query]], dim=1)


def match(
    query: Features,
    train: Features,
    *,
    ratio: float = 0.8,
    mutual: bool = True,
    rotation_deg: float = 0.0,
    max_angle_diff_deg: float | None = None,
    scale: float = 1.0,
    max_scale_factor: float | None = None,
) -> Matches:
    """Match descriptors by Euclidean distance, with Lowe's ratio test and a mutual test.

    Where the relation of the images is known, pairs that contradict it can be left out before the nearest is
    sought: d[q, t] = sqrt(2 - 2 <q, t>) where allowed, else infinite.

    Args:
        query: Features of B images, or of one that meets each of the train's.
        train: Features of B images, or of one that meets each of the query's.
        ratio: Upper bound on nearest over second nearest distance; 1 accepts all.
        mutual: Ask that the query is also the train's nearest.
        rotation_deg: Known angle of a train keypoint less that of its query.
        max_angle_diff_deg: Leave out pairs whose angles differ from ``rotation_deg`` by more.
        scale: Known scale of a train keypoint over that of its query.
        max_scale_factor: Leave out pairs whose scales differ from ``scale`` by more than this factor.
    """
    if not 0 < ratio <= 1:
        raise OptionError(f"ratio: expected a number in (0, 1], got {ratio}")
    with torch.inference_mode():
        allowed = query.valid[:, :, None] & train.valid[:, None, :]
        if max_angle_diff_deg is not None:
            turn = train.angle_deg[:, None, :] - query.angle_deg[:, :, None] - rotation_deg
            allowed &= ((turn + 180).remainder(360) - 180).abs() <= max_angle_diff_deg
        if max_scale_factor is not None:
            factor = train.scale_px[:, None, :] / (query.scale_px[:, :, None] * scale)
            allowed &= (factor <= max_scale_factor) & (factor * max_scale_factor >= 1)
        cosine = query.descriptors @ train.descriptors.mT
        squared = (2 - 2 * cosine).clamp_min_(0).masked_fill_(~allowed, torch.inf)
        nearest, index = squared.min(dim=2)
        second = squared.scatter(2, index[:, :, None], torch.inf).amin(dim=2)
        quotient = (nearest / second.clamp_min(1e-12)).sqrt().nan_to_num(1.0)
        valid = nearest.isfinite() & (quotient <= ratio)
        if mutual:
            back = squared.argmin(dim=1).gather(1, index)
            valid &= back == torch.arange(index.shape[1], device=index.device)
    return Matches(index, nearest.sqrt(), quotient, valid)


# Checks.


def _check_images(images: Tensor, mask: Tensor | None) -> None:
    if images.ndim != 4 or images.shape[1] != 1 or 0 in images.shape:
        raise ShapeError(f"images: expected (B, 1, H, W), got {tuple(images.shape)}")
    if not images.is_floating_point():
        raise DtypeError(f"images: expected floating point, got {images.dtype}")
    if mask is not None and mask.shape != images.shape:
        raise ShapeError(f"mask: expected {tuple(images.shape)} as the images, got {tuple(mask.shape)}")
    if mask is not None and mask.dtype != torch.bool:
        raise DtypeError(f"mask: expected bool, got {mask.dtype}")


def _check_options(max_keypoints: int, upsample: float, contrast_threshold: float, spread: int) -> None:
    if max_keypoints < 1:
        raise OptionError(f"max_keypoints: expected at least 1, got {max_keypoints}")
    if upsample not in (1, 1.5, 2):
        raise OptionError(f"upsample: expected 1, 1.5 or 2, got {upsample}")
    if not contrast_threshold >= 0:
        raise OptionError(f"contrast_threshold: expected a number from 0 up, got {contrast_threshold}")
    if spread < 1:
        raise OptionError(f"spread: expected at least 1, got {spread}")


# Scale space.


@dataclass(frozen=True, slots=True)
class _Band:
    """Gaussian filters of all levels along one axis, cut into the blocks of a banded matrix."""

    blocks: Tensor  # (blocks, levels, outputs, inputs)
    reach: int  # inputs that a block takes on either side of its own

    @property
    def padded(self) -> int:
        return self.blocks.shape[0] * _BLOCK + 2 * self.reach


def _band(inputs: int, sigmas: tuple[float, ...], upsample: float, device: torch.device) -> _Band:
    """Return G[l, i, j] ~ exp(-(i / upsample - j)^2 / (2 sigma_l^2)), rows summing to 1 also at the edges."""
    outputs = _outputs(inputs, upsample)
    reach = math.ceil(_TRUNCATE * max(sigmas))
    rows = round(_BLOCK * upsample)
    count = math.ceil(outputs / rows)
    out = np.arange(count * rows).reshape(count, 1, rows, 1)
    source = (np.arange(count)[:, None] * _BLOCK + np.arange(-reach, _BLOCK + reach)).reshape(count, 1, 1, -1)
    spread = np.maximum(np.array(sigmas), 1e-3).reshape(1, -1, 1, 1)
    weights = np.exp(-0.5 * ((out / upsample - source) / spread) ** 2)
    weights *= (source >= 0) & (source < inputs) & (out < outputs)
    weights /= np.maximum(weights.sum(-1, keepdims=True), 1e-30)
    return _Band(torch.from_numpy(weights.astype(np.float32)).to(device), reach)


def _outputs(inputs: int, upsample: float) -> int:
    return math.floor((inputs - 1) * upsample) + 1


@dataclass(frozen=True, slots=True)
class _Octave:
    """Where an octave lies in the flat buffer of Gaussians: levels x rows x images x columns."""

    height: int
    width: int
    shape: tuple[int, int, int, int]  # with the blocks' padding
    offset: int
    vertical: _Band
    horizontal: _Band

    def levels(self, gaussians: Tensor) -> Tensor:
        """Return the octave's part of the buffer, (levels, rows, images, columns)."""
        return gaussians[self.offset : self.offset + math.prod(self.shape)].view(self.shape)


@dataclass(frozen=True, slots=True)
class _Plan:
    """What depends on the images' shape alone."""

    upsample: float
    octaves: tuple[_Octave, ...]
    gaussian_size: int
    table: Tensor  # (octaves, 6) int64: height, width, offset, and the strides of level, row and image

    @property
    def index(self) -> torch.dtype:
        """The integer that holds every index of the buffer; the shorter one gathers faster."""
        return torch.int32 if self.gaussian_size < 2**31 else torch.int64

    @property
    def first_sigma(self) -> float:
        """Sigma of each octave's first level in pixels of the octave."""
        return _FIRST_SIGMA_PX * self.upsample


@lru_cache(maxsize=32)
def _plan(height: int, width: int, batch: int, upsample: float, device: torch.device) -> _Plan:
    growth = [2.0 ** (level / _SCALES) for level in range(_LEVELS)]
    sigmas = tuple(math.sqrt((_FIRST_SIGMA_PX * g) ** 2 - _CAMERA_SIGMA_PX**2) for g in growth)
    octaves: list[_Octave] = []
    size = 0
    while not octaves or min(height, width) >= _SMALLEST_OCTAVE:
        factor = 1.0 if octaves else upsample
        vertical, horizontal = (_band(n, sigmas, factor, device) for n in (height, width))
        if not octaves:
            height, width = _outputs(height, upsample), _outputs(width, upsample)
        rows, columns = (b.blocks.shape[0] * b.blocks.shape[2] for b in (vertical, horizontal))
        shape = (_LEVELS, rows, batch, columns)
        octaves.append(_Octave(height, width, shape, size, vertical, horizontal))
        size += math.prod(shape)
        sigmas = tuple(_FIRST_SIGMA_PX * upsample * math.sqrt(g**2 - 1) for g in growth)
        height, width = (height + 1) // 2, (width + 1) // 2
    table = [
        (o.height, o.width, o.offset, math.prod(o.shape[1:]), math.prod(o.shape[2:]), o.shape[3]) for o in octaves
    ]
    return _Plan(upsample, tuple(octaves), size, torch.tensor(table, device=device))


def _scale_space(images: Tensor, plan: _Plan) -> Tensor:
    """Return all Gaussian levels of all octaves, flat, from images (B, H, W)."""
    gaussians = images.new_empty(plan.gaussian_size)
    for octave in plan.octaves:
        images = _blur(images, octave, gaussians)[_SCALES, :, ::2, ::2]
    return gaussians


def _blur(images: Tensor, octave: _Octave, gaussians: Tensor) -> Tensor:
    """Write the octave's levels G_y I G_x^T into their place and return them as (L, B, height, width)."""
    batch, height, width = images.shape
    across, down = octave.horizontal, octave.vertical
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


# Detection.


@dataclass(frozen=True, slots=True)
class _Points:
    """Keypoints in the pixels of their octave."""

    octave: Tensor  # int64, as image and level
    image: Tensor
    level: Tensor
    x: Tensor
    y: Tensor
    growth: Tensor  # sigma over the sigma of the octave's first level
    contrast: Tensor
    pixel_px: Tensor  # image pixels per octave pixel

    def take(self, index: Tensor) -> "_Points":
        fields = (self.octave, self.image, self.level, self.x, self.y, self.growth, self.contrast, self.pixel_px)
        return _Points(*(field[index] for field in fields))


def _detect(gaussians: Tensor, plan: _Plan, contrast_threshold: float) -> _Points:
    """Find the extrema of all octaves, refine them, and drop those of low contrast and on edges."""
    threshold = contrast_threshold / _SCALES
    found = [_extrema(gaussians, octave, _EARLY * threshold) for octave in plan.octaves]
    number = torch.cat([torch.full_like(f[:, 0], n) for n, f in enumerate(found)])
    level, y, image, x = torch.cat(found).unbind(1)
    for last in (False,) * _MOVES + (True,):
        value, gradient, hessian, shift = _fit_quadratic(gaussians, plan, number, level, image, y, x)
        if not last:
            step = torch.where(shift.abs() > 0.5, shift.sign(), 0.0).long().unbind(1)
            x = (x + step[0]).clamp_min_(1).minimum(plan.table[number, 1] - 2)
            y = (y + step[1]).clamp_min_(1).minimum(plan.table[number, 0] - 2)
            level = (level + step[2]).clamp_(1, _SCALES)
    contrast = (value + 0.5 * (gradient * shift).sum(1)).abs()
    xx, yy, _, xy, _, _ = hessian.unbind(1)
    trace, determinant = xx + yy, xx * yy - xy * xy
    keep = (contrast >= threshold) & (shift.abs().amax(1) < _FARTHEST)
    keep &= (determinant > 0) & (trace * trace * _EDGE_RATIO < (_EDGE_RATIO + 1) ** 2 * determinant)
    growth = torch.exp2((level + shift[:, 2]) / _SCALES)
    pixel = torch.exp2(number.float()) / plan.upsample
    points = _Points(number, image, level, x + shift[:, 0], y + shift[:, 1], growth, contrast, pixel)
    return points.take(keep.nonzero()[:, 0])


def _extrema(gaussians: Tensor, octave: _Octave, threshold: float) -> Tensor:
    """Return (M, 4) level, y, image, x where |DoG| is the largest of its 3 x 3 x 3 and above the threshold."""
    levels = octave.levels(gaussians)[..., _BORDER - 1 : octave.width - _BORDER + 1]
    begin, end = _BORDER, octave.height - _BORDER
    found = [torch.zeros(0, 4, dtype=torch.int64, device=gaussians.device)]
    if levels.shape[3] < 3:
        return found[0]
    rows = max(16, _STRIP // octave.width) if gaussians.device.type == "cpu" else octave.height
    for y in range(begin, end, rows):  # a strip stays in a processor's cache
        strip = levels[:, y - 1 : min(y + rows, end) + 1]
        size = torch.sub(strip[1:], strip[:-1]).abs_()
        top = torch.maximum(torch.maximum(size[:-2], size[1:-1]), size[2:])
        top = torch.maximum(torch.maximum(top[:, :-2], top[:, 1:-1]), top[:, 2:])
        top = torch.maximum(torch.maximum(top[..., :-2], top[..., 1:-1]), top[..., 2:]).clamp_min_(threshold)
        first = torch.tensor([1, y, 0, _BORDER], device=gaussians.device)
        found.append(_nonzero(size[1:-1, 1:-1, :, 1:-1] >= top) + first)
    return torch.cat(found)


def _nonzero(mask: Tensor) -> Tensor:
    """Return mask.nonzero(), by looking at eight elements at a time: few are True."""
    padded = torch.nn.functional.pad(mask.flatten(), (0, -mask.numel() % 8))
    words = padded.view(torch.int64).nonzero()
    index = (words * 8 + torch.arange(8, device=mask.device)).flatten()
    return torch.stack(torch.unravel_index(index[padded[index]], mask.shape), dim=1)


def _fit_quadratic(
    gaussians: Tensor, plan: _Plan, number: Tensor, level: Tensor, image: Tensor, y: Tensor, x: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Fit D(p) = D + g p + p H p / 2 at voxels: D (M,), g (M, 3), H as (M, 6), and the extremum -H^-1 g (M, 3)."""
    stencil, neighbours = _quadratic(gaussians.device)
    _, _, offset, per_level, per_row, per_image = plan.table[number].unbind(1)
    centre = offset + level * per_level + y * per_row + image * per_image + x
    s, v, u = neighbours.unbind(1)
    centre, per_level, per_row = (t.to(plan.index)[:, None] for t in (centre, per_level, per_row))
    index = centre + s * per_level + v * per_row + u
    voxels = gaussians.index_select(0, index.flatten()).view(-1, 4, 9)
    cube = (voxels[:, 1:] - voxels[:, :-1]).view(-1, 27)
    fit = cube @ stencil
    gradient, hessian = fit[:, :3], fit[:, 3:]
    rows = hessian[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].view(-1, 3, 3)
    adjugate = torch.linalg.cross(rows[:, [1, 2, 0]], rows[:, [2, 0, 1]])
    determinant = (rows[:, 0] * adjugate[:, 0]).sum(1, keepdim=True)
    shift = -(gradient[:, None, :] @ adjugate)[:, 0] / torch.where(determinant == 0, 1e-30, determinant)
    return cube[:, 13], gradient, hessian, shift.clamp(-9, 9)


@lru_cache(maxsize=8)
def _quadratic(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return (27, 9), Lowe's differences for x, y, s, xx, yy, ss, xy, xs, ys of the neighbours (s, y, x) of a DoG.

    And (36, 3) int32, the Gaussians (s, y, x) that they are differences of: one level more.
    """
    gaussians = np.stack(np.meshgrid([-1, 0, 1, 2], [-1, 0, 1], [-1, 0, 1], indexing="ij"), -1).reshape(36, 3)
    s, y, x = gaussians[:27].T

    def first(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.asarray(a / 2 * (b == 0) * (c == 0))

    def second(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.asarray(np.where(a == 0, -2.0, 1.0) * (b == 0) * (c == 0))

    def cross(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return np.asarray(a * b / 4 * (c == 0))

    columns = [first(x, y, s), first(y, s, x), first(s, x, y), second(x, y, s), second(y, s, x), second(s, x, y)]
    columns += [cross(x, y, s), cross(x, s, y), cross(y, s, x)]
    stencil = torch.from_numpy(np.stack(columns, 1).astype(np.float32)).to(device)
    return stencil, torch.from_numpy(gaussians.astype(np.int32)).to(device)


def _allowed(points: _Points, mask: Tensor) -> Tensor:
    """Return the indices of the points whose nearest pixel is True in mask (B, 1, H, W)."""
    x = (points.x * points.pixel_px).round().long().clamp_(0, mask.shape[3] - 1)
    y = (points.y * points.pixel_px).round().long().clamp_(0, mask.shape[2] - 1)
    return mask[points.image, 0, y, x].nonzero()[:, 0]


def _strongest(points: _Points, plan: _Plan, max_keypoints: int, spread: int) -> Tensor:
    """Return the indices of the points to keep, ordered by image and then by precedence."""
    order = points.contrast.argsort(descending=True, stable=True)
    octave = plan.octaves[0]
    image = points.image[order]
    x = (points.x * points.pixel_px)[order] * (plan.upsample * spread / octave.width)
    y = (points.y * points.pixel_px)[order] * (plan.upsample * spread / octave.height)
    cell = (image * spread + y.long().clamp_(0, spread - 1)) * spread + x.long().clamp_(0, spread - 1)
    share = 2 * max_keypoints / spread**2
    crowded = _rank(cell) >= share if spread > 1 else torch.zeros_like(image, dtype=torch.bool)
    precedence = (image * 2 + crowded).argsort(stable=True)
    return order[precedence][_rank(image[precedence]) < max_keypoints]


def _rank(group: Tensor) -> Tensor:
    """Return for each element how many before it are of the same group."""
    order = group.argsort(stable=True)
    ordered = group[order]
    place = torch.arange(group.numel(), device=group.device)
    return torch.empty_like(group).scatter_(0, order, place - torch.searchsorted(ordered, ordered))


# Orientation and description.


def _sample(gaussians: Tensor, points: _Points, plan: _Plan, x: Tensor, y: Tensor) -> Tensor:
    """Return the points' Gaussian levels at x, y (P, S) in octave pixels, bilinear, edges extended."""
    height, width, offset, per_level, per_row, per_image = plan.table[points.octave].unbind(1)
    base = (offset + points.level * per_level + points.image * per_image).to(plan.index)[:, None]
    height, width, per_row = height[:, None], width[:, None], per_row.to(plan.index)[:, None]
    x = torch.minimum(x.clamp_min(0), (width - 1).float() - 1e-3)
    y = torch.minimum(y.clamp_min(0), (height - 1).float() - 1e-3)
    left, top = x.floor(), y.floor()
    fx, fy = x - left, y - top
    corner = top.to(plan.index) * per_row + left.to(plan.index) + base
    a, b, c, d = (
        gaussians.index_select(0, at.flatten()).view_as(x)
        for at in (corner, corner + 1, corner + per_row, corner + per_row + 1)
    )
    upper = torch.lerp(a, b, fx)
    return torch.lerp(upper, torch.lerp(c, d, fx), fy)


def _gradients(
    gaussians: Tensor, points: _Points, plan: _Plan, angle: Tensor | None, samples: int, step: float
) -> tuple[Tensor, Tensor]:
    """Return gx, gy (P, samples^2) on a grid around each point, in the point's frame turned by angle."""
    ramp = torch.arange(samples + 2, device=gaussians.device) - 0.5 * (samples + 1)
    v, u = (g.flatten() for g in torch.meshgrid(ramp, ramp, indexing="ij"))
    sigma = (plan.first_sigma * step * points.growth)[:, None]
    if angle is None:
        x, y = points.x[:, None] + sigma * u, points.y[:, None] + sigma * v
    else:
        cos, sin = sigma * angle.cos()[:, None], sigma * angle.sin()[:, None]
        x = points.x[:, None] + cos * u - sin * v
        y = points.y[:, None] + sin * u + cos * v
    patch = _sample(gaussians, points, plan, x, y).unflatten(1, (samples + 2, samples + 2))
    gx = patch[:, 1:-1, 2:] - patch[:, 1:-1, :-2]
    gy = patch[:, 2:, 1:-1] - patch[:, :-2, 1:-1]
    return gx.flatten(1), gy.flatten(1)


def _dominant_angle(gaussians: Tensor, points: _Points, plan: _Plan) -> Tensor:
    """Return the angle (radians) of the highest peak in the histogram of gradient directions."""
    gx, gy = _gradients(gaussians, points, plan, None, _ORIENT_SAMPLES, _ORIENT_STEP)
    window, smooth = _orientation_weights(gaussians.device)
    bins = (torch.atan2(gy, gx) * (_ANGLE_BINS / math.tau)).round_().long()
    bins = torch.where(bins < 0, bins + _ANGLE_BINS, bins)
    histogram = gx.new_zeros(len(gx), _ANGLE_BINS).scatter_add_(1, bins, torch.hypot(gx, gy) * window) @ smooth
    peak = histogram.argmax(1, keepdim=True)
    left, top, right = (histogram.gather(1, (peak + k).remainder(_ANGLE_BINS)) for k in (-1, 0, 1))
    offset = 0.5 * (left - right) / (left - 2 * top + right).clamp_max(-1e-12)
    return ((peak + offset) * (math.tau / _ANGLE_BINS))[:, 0]


@lru_cache(maxsize=8)
def _orientation_weights(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the window (S,) of sigma 1.5 keypoint sigmas, and the (36, 36) circular smoothing 1 4 6 4 1."""
    ramp = (np.arange(_ORIENT_SAMPLES) - (_ORIENT_SAMPLES - 1) / 2) * _ORIENT_STEP
    window = np.exp(-0.5 * (ramp[:, None] ** 2 + ramp**2) / 1.5**2).ravel()
    taps = zip((-2, -1, 0, 1, 2), (1, 4, 6, 4, 1), strict=True)
    smooth = sum(weight / 16 * np.roll(np.eye(_ANGLE_BINS), shift, 1) for shift, weight in taps)
    return torch.from_numpy(window.astype(np.float32)).to(device), torch.from_numpy(smooth).float().to(device)


def _describe(gaussians: Tensor, points: _Points, angle: Tensor, plan: _Plan, *, root: bool) -> Tensor:
    """Return (P, 128) descriptors: 4 x 4 cells of 8 orientations, all in the keypoint's frame."""
    step = _CELL_SIGMAS / _CELL_SAMPLES
    gx, gy = _gradients(gaussians, points, plan, angle, _DESC_SAMPLES, step)
    pooled = _orient(gx, gy) @ _pooling(gaussians.device)  # (8, P, 16)
    return _normalise(pooled.permute(1, 2, 0).flatten(1), root=root)


def _orient(gx: Tensor, gy: Tensor) -> Tensor:
    """Split gradients between their two neighbouring of 8 directions, (8, ...).

    A vector in the sector of e_k and e_(k+1), 45 degrees apart, is a e_k + b e_(k+1) with a, b >= 0. The weight
    a is (g x e_(k+1)) / sin 45, b of the next sector (e_(k-1) x g) / sin 45, and the smaller of the two is
    positive in e_k's two sectors only. As e_j x g = <g, e_(j+2)>, with p_j = <g, e_j> up to a factor:
    w_k = max(0, min(p_(k-1), p_(k+1))).
    """
    half = math.sqrt(0.5)
    diagonal, anti = half * (gx + gy), half * (gy - gx)
    p = torch.stack([gx, diagonal, gy, anti, -gx, -diagonal, -gy, -anti])
    return torch.minimum(p.roll(1, 0), p.roll(-1, 0)).clamp_min_(0)


@lru_cache(maxsize=8)
def _pooling(device: torch.device) -> Tensor:
    """Return (S, 16): bilinear weights of the samples in the cells, times a Gaussian of half the width."""
    ramp = (np.arange(_DESC_SAMPLES) - (_DESC_SAMPLES - 1) / 2) / _CELL_SAMPLES
    centres = np.arange(_CELLS) - (_CELLS - 1) / 2
    tent = np.maximum(0, 1 - np.abs(ramp[:, None] - centres)) * np.exp(-0.5 * (ramp[:, None] / (_CELLS / 2)) ** 2)
    weights = np.einsum("yr,xc->yxrc", tent, tent).reshape(_DESC_SAMPLES**2, _CELLS**2)
    return torch.from_numpy(weights.astype(np.float32)).to(device)


def _normalise(descriptors: Tensor, *, root: bool) -> Tensor:
    """Return unit vectors, entries bounded by 0.2 before the last normalisation; RootSIFT if root."""
    unit = torch.nn.functional.normalize(descriptors, dim=-1).clamp_max_(0.2)
    if root:
        return torch.nn.functional.normalize(unit, p=1.0, dim=-1).sqrt()
    return torch.nn.functional.normalize(unit, dim=-1)


def _to_slots(points: _Points, angle: Tensor, descriptors: Tensor, batch: int, slots: int) -> Features:
    """Scatter points, ordered by image, into (B, N) slots."""
    index = points.image * slots + _rank(points.image)

    def place(values: Tensor) -> Tensor:
        out = values.new_zeros(batch * slots, *values.shape[1:])
        out[index] = values
        return out.view(batch, slots, *values.shape[1:])

    xy = torch.stack([points.x, points.y], dim=1) * points.pixel_px[:, None]
    scale = _FIRST_SIGMA_PX * points.growth * torch.exp2(points.octave.float())
    degrees = torch.rad2deg(angle).remainder(360)
    return Features(*map(place, (xy, scale, degrees, descriptors, torch.ones_like(index, dtype=torch.bool))))
