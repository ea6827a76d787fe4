"""NCC by the FFT in plain torch: one forward transform a picture, one inverse a template.

The numerator of equation 1 is a circular correlation; a period of the window's own size is enough, since the
shifts that wrap around are never returned. The denominator comes from running sums in float64.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

# A float32 transform leaves an error of about 1e-7 of the window's norm in every numerator. It is divided by the
# norm of a patch: where a patch is this many times weaker than the window, the transform runs in float64.
_FLOAT32_NORM_RATIO = 16.0
# A patch is flat where its sum of squares is below this share of the window's: there is only rounding in it.
_FLAT_SHARE = 1e-12
# Windows of more pixels than this are cut into blocks where the templates are small against them.
_WORTH_BLOCKS_PX = 1 << 21
# Blocks of windows that are larger than the templates have at least this side.
_MIN_BLOCK_PX = 256
_SMALL_PX = 1 << 16
# The norm of a template of zeros, which scores 0.
_TINY = 1e-12
# Templates are transformed in groups whose product spectra hold at most this many numbers, to bound the memory.
_CHUNK_NUMBERS = 1 << 24


@lru_cache(maxsize=4096)
def fast_length(n: int) -> int:
    """The smallest length of at least ``n`` that has no prime factor above 5, which FFTs do fast."""
    best = 1 << (n - 1).bit_length()
    five = 1
    while five < best:
        three = five
        while three < best:
            length = three << max(0, (-(-n // three) - 1).bit_length())
            best = min(best, length)
            three *= 3
        five *= 5
    return best


def ncc_surface(search: Tensor, templates: Tensor, *, zero_mean: bool) -> Tensor:
    """Equation 1 of the paper, (B, H, W) and (B, T, h, w) to (B, T, H-h+1, W-w+1) in the input's dtype."""
    if zero_mean:  # NCC does not see the window's mean, but the squares below stay small without it
        search = (search - search.mean(dim=(-2, -1), keepdim=True, dtype=torch.float64)).to(search.dtype)
        templates = templates - templates.mean(dim=(-2, -1), keepdim=True, dtype=torch.float64)
        templates = templates - templates.mean(dim=(-2, -1), keepdim=True)  # what rounding left of a flat one
    scores = [_one_surface(picture, group, zero_mean) for picture, group in zip(search, templates, strict=True)]
    return torch.stack(scores).to(search.dtype)


def _one_surface(search: Tensor, templates: Tensor, zero_mean: bool) -> Tensor:
    h, w = templates.shape[-2:]
    sums = integrals(search)
    energy = box_energy(sums, h, w) if zero_mean else box_sum(sums[1], h, w)
    window_energy = float(sums[1, -1, -1])
    flat = energy <= _FLAT_SHARE * window_energy
    energy.masked_fill_(flat, torch.inf)
    single = search.dtype != torch.float64 and window_energy <= _FLOAT32_NORM_RATIO**2 * float(energy.min())
    work = torch.float32 if single else torch.float64
    norm = torch.linalg.vector_norm(templates, dim=(-2, -1), keepdim=True, dtype=torch.float64)
    normal = (templates / norm.clamp_min(_TINY)).to(work)  # a flat template is all zeros, and scores 0 everywhere
    return correlate(search.to(work), normal).mul_(energy.to(work).rsqrt_()).clamp_(-1.0, 1.0)


def prepared_surface(image: Tensor, inverse_norms: Tensor, templates: Tensor) -> Tensor:
    """Zero-mean NCC of zero-mean float32 templates (T, h, w) with a picture (H, W) of small mean.

    Args:
        image: (H, W) float32.
        inverse_norms: (H-h+1, W-w+1) from :func:`inverse_norm`.
        templates: (T, h, w) float32 of zero mean.
    """
    return products(image, templates).mul_(inverse_norms).clamp_(-1.0, 1.0)


def products(image: Tensor, templates: Tensor) -> Tensor:
    """Numerators of the same (T, H-h+1, W-w+1), the templates scaled to a norm of 1."""
    norm = torch.linalg.vector_norm(templates, dim=(-2, -1), keepdim=True).clamp_min_(_TINY)
    return correlate(image, templates / norm)


def peak(products: Tensor, inverse_norms: Tensor) -> tuple[Tensor, Tensor]:
    """Best score (T,) of every template and its flat place (T,), the lowest of equals."""
    scores = _scores(products, inverse_norms).flatten(1)
    places = scores.argmax(dim=1, keepdim=True)
    return scores.gather(1, places)[:, 0], places[:, 0]


def rival(products: Tensor, inverse_norms: Tensor, winner: Tensor, radius_squared: int) -> Tensor:
    """Best score (T,) of every template further than a radius from a flat place; -1 where nothing is."""
    height, width = inverse_norms.shape
    dy = torch.arange(height, device=winner.device)[:, None] - winner // width
    dx = torch.arange(width, device=winner.device) - winner % width
    scores = _scores(products, inverse_norms)
    return scores.masked_fill_(dy * dy + dx * dx <= radius_squared, -1.0).amax(dim=(1, 2))


def _scores(products: Tensor, inverse_norms: Tensor) -> Tensor:
    return (products * inverse_norms).clamp_(-1.0, 1.0)


def inverse_norm(sums: Tensor, h: int, w: int) -> Tensor:
    """One over the norm of every h x w patch about its mean, float32; 0 where the patch is flat.

    Args:
        sums: (2, H+1, W+1) running sums of a picture, or a crop of those of a larger one.
        h: rows of a patch.
        w: columns of a patch.
    """
    # On small surfaces on the CPU a call of torch's costs more than its work.
    if sums.device.type == "cpu" and sums[0].numel() <= _SMALL_PX:
        s = sums.numpy()
        boxes = s[:, h:, w:] - s[:, :-h, w:]
        boxes -= s[:, h:, :-w]
        boxes += s[:, :-h, :-w]
        total, square = boxes
        square -= np.square(total, out=total) * (1.0 / (h * w))
        floor = _FLAT_SHARE * (s[1, -1, -1] - s[1, 0, 0])
        if square.min() <= floor:
            square[square <= floor] = np.inf
        return torch.from_numpy(np.reciprocal(np.sqrt(square, out=square), out=square).astype(np.float32))
    energy = box_energy(sums, h, w)
    floor = _FLAT_SHARE * (sums[1, -1, -1] - sums[1, 0, 0])  # no less than the window's own energy
    return energy.masked_fill_(energy <= floor, torch.inf).float().rsqrt_()


def correlate(search: Tensor, templates: Tensor) -> Tensor:
    """Sums of products (T, H-h+1, W-w+1) of (T, h, w) at every place of (H, W), by the correlation theorem.

    A window much larger than the templates is cut into overlapping blocks (overlap-save), whose transforms are
    small enough to stay in the cache.
    """
    (H, W), (h, w) = search.shape, templates.shape[-2:]
    block = fast_length(max(_MIN_BLOCK_PX, 3 * max(h, w)))
    if max(_WORTH_BLOCKS_PX, 2 * block * block) < H * W:
        return _correlate_blocks(search, templates, min(block, fast_length(H)), min(block, fast_length(W)))
    rows, columns = fast_length(H), fast_length(W)
    spectrum = torch.fft.rfft2(search, s=(rows, columns))
    count = max(1, _CHUNK_NUMBERS // (2 * spectrum.numel()))
    parts = [
        _inverse(spectrum * torch.fft.rfft2(group, s=(rows, columns)).conj(), H - h + 1, W - w + 1, columns)
        for group in templates.split(count)
    ]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _correlate_blocks(search: Tensor, templates: Tensor, rows: int, columns: int) -> Tensor:
    """The same by blocks of rows x columns, each of which yields rows-h+1 x columns-w+1 places."""
    (H, W), (T, h, w) = search.shape, templates.shape
    step_y, step_x = rows - h + 1, columns - w + 1
    ny, nx = -(-(H - h + 1) // step_y), -(-(W - w + 1) // step_x)
    padded = search.new_zeros((ny - 1) * step_y + rows, (nx - 1) * step_x + columns)
    padded[:H, :W] = search
    blocks = padded.unfold(0, rows, step_y).unfold(1, columns, step_x)  # (ny, nx, rows, columns), no copy
    out = search.new_empty(T, ny * step_y, nx * step_x)
    count = max(1, _CHUNK_NUMBERS // (2 * nx * rows * columns))
    models = torch.fft.rfft2(templates, s=(rows, columns)).conj()
    for j in range(ny):
        spectra = torch.fft.rfft2(blocks[j])
        for first in range(0, T, count):
            product = spectra * models[first : first + count, None]
            places = _inverse(product, step_y, step_x, columns)  # (t, nx, step_y, step_x)
            line = places.permute(0, 2, 1, 3).reshape(places.shape[0], step_y, nx * step_x)
            out[first : first + count, j * step_y : (j + 1) * step_y] = line
    return out[:, : H - h + 1, : W - w + 1]


def _inverse(spectrum: Tensor, height: int, width: int, columns: int) -> Tensor:
    """The top-left (height, width) of irfft2, that does not transform the rows that nobody asks for."""
    rows = torch.fft.ifft(spectrum, dim=-2)[..., :height, :]
    picture: Tensor = torch.fft.irfft(rows, n=columns)
    return picture[..., :width]


def integrals(image: Tensor) -> Tensor:
    """Running sums (2, H+1, W+1) of (H, W) and of its square, in float64."""
    if image.device.type == "cpu":
        both = np.empty((2, image.shape[0] + 1, image.shape[1] + 1))
        cv2.integral2(image.contiguous().numpy(), both[0], both[1], sdepth=cv2.CV_64F, sqdepth=cv2.CV_64F)
        return torch.from_numpy(both)
    wide = torch.nn.functional.pad(image.double(), (1, 0, 1, 0))
    return torch.stack([wide, wide.square()]).cumsum_(-1).cumsum_(-2)


def halved(image: Tensor) -> Tensor:
    """Means of 2 x 2 pixels of (H, W) float32; an odd last row or column is left out."""
    height, width = image.shape[0] & ~1, image.shape[1] & ~1
    even = image[:height, :width]
    if image.device.type == "cpu":
        size = (width // 2, height // 2)
        return torch.from_numpy(cv2.resize(even.numpy(), size, interpolation=cv2.INTER_AREA))
    return torch.nn.functional.avg_pool2d(even[None, None], 2)[0, 0]


def box_sum(total: Tensor, h: int, w: int) -> Tensor:
    """Sums over every h x w patch, from running sums (..., H+1, W+1) or a crop of them."""
    return (total[..., h:, w:] - total[..., :-h, w:]).sub_(total[..., h:, :-w]).add_(total[..., :-h, :-w])


def box_energy(sums: Tensor, h: int, w: int) -> Tensor:
    """Sum of squares about its own mean of every h x w patch, from both running sums (2, H+1, W+1)."""
    total, square = box_sum(sums, h, w)
    energy: Tensor = square.addcmul_(total, total, value=-1.0 / (h * w))
    return energy
