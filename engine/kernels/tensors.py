"""NCC by the FFT in plain torch: one forward transform per picture, one inverse per template.

The numerator of equation 1 is a circular correlation; a period of the window's size suffices, since the shifts
that wrap around are never returned. The denominator comes from running sums in float64.
"""

from __future__ import annotations

import math

import cv2

from engine.kernels.sums import FLAT_SHARE, box_sum, check_finite
from engine.runtime.tensors import Tensor, torch

# Upper bound on the numbers in the product spectra of a group of templates, which bounds the memory.
_CHUNK_NUMBERS = 1 << 24


def check_all_finite(**tensors: Tensor) -> None:
    """Check that no value is NaN or infinity; finite sums imply that, are faster, and are copied at once.

    Args:
        tensors: by the name of the argument, of any shape, on one device.

    Raises:
        OptionError: one is.
    """
    totals = torch.stack([tensor.detach().sum().double() for tensor in tensors.values()]).cpu().tolist()
    for (name, tensor), total in zip(tensors.items(), totals, strict=True):
        check_finite(name, math.isfinite(total) or bool(torch.isfinite(tensor).all()))


def ncc_surface(search: Tensor, templates: Tensor, *, zero_mean: bool) -> Tensor:
    """NCC by equation 1.

    Args:
        search: (B, H, W) float32 or float64.
        templates: (B, T, h, w) of the same dtype.
        zero_mean: subtract the means first.

    Returns:
        (B, T, H-h+1, W-w+1) of the same dtype, in [-1, 1]; 0 where patch or template is flat.

    Raises:
        OptionError: NaN or infinity.
    """
    given = {"search": search, "templates": templates}
    if zero_mean:  # NCC is invariant to the window's mean, but without it the squares below stay small
        search = (search - search.mean(dim=(-2, -1), keepdim=True, dtype=torch.float64)).to(search.dtype)
        templates = templates - templates.mean(dim=(-2, -1), keepdim=True, dtype=torch.float64)
        templates = templates - templates.mean(dim=(-2, -1), keepdim=True)  # the rounding residue of a flat one
    h, w = templates.shape[-2:]
    inverse_norms = _inverse_norms(integrals(search), h, w, zero_mean=zero_mean)
    scores = _scores(search.double(), inverse_norms, templates.double())
    check_all_finite(**given)  # last: the host waits for it
    return scores.to(search.dtype)


def prepared_surface(image: Tensor, inverse_norms: Tensor, templates: Tensor) -> Tensor:
    """Zero-mean NCC with a picture whose patches' norms are known.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        inverse_norms: (H-h+1, W-w+1) from :func:`inverse_norm`.
        templates: (T, h, w) float32 of zero mean.

    Returns:
        (T, H-h+1, W-w+1) float32 in [-1, 1].
    """
    return _scores(image[None], inverse_norms[None], templates[None])[0]


def _scores(search: Tensor, inverse_norms: Tensor, templates: Tensor) -> Tensor:
    """Scores (B, T, H', W') by inverse norms (B, H', W'); a flat template is all zeros, and scores 0."""
    norm = torch.linalg.vector_norm(templates, dim=(-2, -1), keepdim=True)
    normal = templates / norm.clamp_min(torch.finfo(norm.dtype).tiny)
    return correlate(search, normal).mul_(inverse_norms[:, None]).clamp_(-1.0, 1.0)


def peak_numbers(scores: Tensor, exclusion_px: float) -> list[float]:
    """The numbers that define a surface's peak, found on its device and copied at once.

    Args:
        scores: (H', W').
        exclusion_px: radius about the peak within which no rival is counted.

    Returns:
        28: flat index, the lowest of equal ones; score; the rival's score, -1 if there is none; and the 5 x 5
        scores about the peak, those on the border repeated beyond it.
    """
    with torch.inference_mode():
        scores, (height, width) = scores.float(), scores.shape
        index = scores.flatten().argmax(dim=0, keepdim=True)
        row, column = index // width, index % width
        dy, dx = (torch.arange(n, device=index.device) - at for n, at in ((height, row), (width, column)))
        inside = dy.square()[:, None] + dx.square() <= math.floor(exclusion_px * exclusion_px)
        rival = scores.masked_fill(inside, -1.0).amax()
        near = torch.arange(-2, 3, device=index.device)
        around = scores[(row + near).clamp(0, height - 1)[:, None], (column + near).clamp(0, width - 1)]
        best = scores.flatten().gather(0, index)
        return torch.cat([index.double(), best, rival[None], around.flatten()]).cpu().tolist()


def inverse_norm(sums: Tensor, h: int, w: int) -> Tensor:
    """Reciprocal norm about the mean of every patch.

    Args:
        sums: (2, H+1, W+1) from :func:`integrals`, or a crop of a larger picture's.
        h: rows of a patch.
        w: columns of a patch.

    Returns:
        (H-h+1, W-w+1) float32; 0 where a patch is flat.
    """
    return _inverse_norms(sums, h, w, zero_mean=True).float()


def _inverse_norms(sums: Tensor, h: int, w: int, *, zero_mean: bool) -> Tensor:
    """The same in float64 of one picture or many, on request of the squares themselves."""
    (total, energy), squares = box_sum(sums, h, w), sums[1]
    if zero_mean:
        energy.addcmul_(total, total, value=-1.0 / (h * w))
    floor = FLAT_SHARE * (squares[..., -1:, -1:] - squares[..., :1, :1])  # no less than the window's own energy
    inverse: Tensor = energy.masked_fill_(energy <= floor, torch.inf).rsqrt_()
    return inverse


def correlate(search: Tensor, templates: Tensor) -> Tensor:
    """Cross-correlation by the correlation theorem.

    Args:
        search: (B, H, W) floating point.
        templates: (B, T, h, w) of the same dtype.

    Returns:
        (B, T, H-h+1, W-w+1) sums of products.
    """
    (H, W), (h, w) = search.shape[1:], templates.shape[2:]
    rows, columns = size = cv2.getOptimalDFTSize(H), cv2.getOptimalDFTSize(W)
    most = max(1, _CHUNK_NUMBERS // (2 * rows * (columns // 2 + 1)))
    found = []
    for pictures, models in zip(search.split(most), templates.split(most), strict=True):
        spectra = torch.fft.rfft2(pictures, s=size)[:, None]
        products = (
            spectra * torch.fft.rfft2(group, s=size).conj() for group in models.split(most // len(pictures), 1)
        )
        found.append(torch.cat([_inverse(product, H - h + 1, W - w + 1, columns) for product in products], 1))
    return found[0] if len(found) == 1 else torch.cat(found)


def _inverse(spectrum: Tensor, height: int, width: int, columns: int) -> Tensor:
    """The top-left (height, width) of irfft2, without the transform of the other rows."""
    rows = torch.fft.ifft(spectrum, dim=-2)[..., :height, :]
    picture: Tensor = torch.fft.irfft(rows, n=columns)
    return picture[..., :width]


def integrals(image: Tensor) -> Tensor:
    """Integral images of pictures and of their squares.

    Args:
        image: (..., H, W) floating point.

    Returns:
        (2, ..., H+1, W+1) float64 running sums; the first row and column are 0.
    """
    wide = torch.nn.functional.pad(image.double(), (1, 0, 1, 0))
    return torch.stack([wide, wide.square()]).cumsum_(-1).cumsum_(-2)
