"""NCC by the FFT in plain torch: one forward transform per picture, one inverse per template.

The numerator of equation 1 is a circular correlation; a period of the window's size suffices, since the shifts
that wrap around are never returned. The denominator comes from running sums in float64.
"""

from __future__ import annotations

import math

from engine.errors import OptionError
from engine.kernels import sums
from engine.kernels.transform_sizes import FLAT_SHARE, FLOAT32_NORM_RATIO, fast_length
from engine.runtime.tensors import Tensor, torch

# Lower bound on a template's norm; a template of zeros scores 0.
_TINY = 1e-12
# Upper bound on the numbers in the product spectra of a group of templates, which bounds the memory.
_CHUNK_NUMBERS = 1 << 24


def check_finite(**tensors: Tensor) -> None:
    """Check that no value is NaN or infinity; finite sums imply that, are faster, and are copied at once.

    Args:
        tensors: by the name of the argument, of any shape, on one device.

    Raises:
        OptionError: one is.
    """
    totals = torch.stack([tensor.detach().sum().double() for tensor in tensors.values()]).cpu().tolist()
    for (name, tensor), total in zip(tensors.items(), totals, strict=True):
        if not (math.isfinite(total) or bool(torch.isfinite(tensor).all())):
            raise OptionError(f"{name}: expected finite values, got NaN or infinity")


def ncc_surface(search: Tensor, templates: Tensor, *, zero_mean: bool) -> Tensor:
    """NCC by equation 1.

    Args:
        search: (B, H, W) float32 or float64.
        templates: (B, T, h, w) of the same dtype.
        zero_mean: subtract the means first.

    Returns:
        (B, T, H-h+1, W-w+1) of the same dtype, in [-1, 1]; 0 where patch or template is flat.
    """
    if zero_mean:  # NCC is invariant to the window's mean, but without it the squares below stay small
        search = (search - search.mean(dim=(-2, -1), keepdim=True, dtype=torch.float64)).to(search.dtype)
        templates = templates - templates.mean(dim=(-2, -1), keepdim=True, dtype=torch.float64)
        templates = templates - templates.mean(dim=(-2, -1), keepdim=True)  # the rounding residue of a flat one
    scores = [_one_surface(picture, group, zero_mean) for picture, group in zip(search, templates, strict=True)]
    return torch.stack(scores).to(search.dtype)


def _one_surface(search: Tensor, templates: Tensor, zero_mean: bool) -> Tensor:
    h, w = templates.shape[-2:]
    sums = integrals(search)
    energy = box_energy(sums, h, w) if zero_mean else box_sum(sums[1], h, w)
    window_energy = sums[1, -1, -1]
    energy.masked_fill_(energy <= FLAT_SHARE * window_energy, torch.inf)
    work = torch.float32 if _suits_float32(search, window_energy, energy) else torch.float64
    norm = torch.linalg.vector_norm(templates, dim=(-2, -1), keepdim=True, dtype=torch.float64)
    normal = (templates / norm.clamp_min(_TINY)).to(work)  # a flat template is all zeros, and scores 0 everywhere
    return correlate(search.to(work), normal).mul_(energy.to(work).rsqrt_()).clamp_(-1.0, 1.0)


def _suits_float32(search: Tensor, window_energy: Tensor, energy: Tensor) -> bool:
    """Whether no patch is too weak for float32; not checked on a GPU, since the host would wait for it."""
    if search.device.type != "cpu" or search.dtype == torch.float64:
        return False
    return float(window_energy) <= FLOAT32_NORM_RATIO**2 * float(energy.min())


def prepared_surface(image: Tensor, inverse_norms: Tensor, templates: Tensor) -> Tensor:
    """Zero-mean NCC with a picture whose patches' norms are known.

    Args:
        image: (H, W) float32, its mean small against its standard deviation.
        inverse_norms: (H-h+1, W-w+1) from :func:`inverse_norm`.
        templates: (T, h, w) float32 of zero mean.

    Returns:
        (T, H-h+1, W-w+1) float32 in [-1, 1].
    """
    return products(image, templates).mul_(inverse_norms).clamp_(-1.0, 1.0)


def products(image: Tensor, templates: Tensor) -> Tensor:
    """Numerators of :func:`prepared_surface`.

    Args:
        image: (H, W) float32, or (T, H, W) if every template has its own.
        templates: (T, h, w) float32 of zero mean, scaled to a norm of 1 here.

    Returns:
        (T, H-h+1, W-w+1) float32.
    """
    norm = torch.linalg.vector_norm(templates, dim=(-2, -1), keepdim=True).clamp_min_(_TINY)
    return correlate(image, templates / norm)


def peak(products: Tensor, inverse_norms: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum of every template's surface.

    Args:
        products: (T, H', W') float32 numerators.
        inverse_norms: (H', W') float32, or (T, H', W').

    Returns:
        Score (T,) and flat index (T,) int64 in (H', W'), the lowest of equal ones; NaN counts as -1.
    """
    scores = _scores(products, inverse_norms).flatten(1)
    index = scores.argmax(dim=1, keepdim=True)
    return scores.gather(1, index)[:, 0], index[:, 0]


def rival(products: Tensor, inverse_norms: Tensor, winner: Tensor, radius_squared: int) -> Tensor:
    """Maximum of every template's surface outside a disc.

    Args:
        products: (T, H', W') float32 numerators.
        inverse_norms: (H', W') float32, or (T, H', W').
        winner: (T,) int64, the flat index of the disc's centre.
        radius_squared: positions of at most this squared distance are inside, in squared pixels.

    Returns:
        (T,) float32; -1 if nothing is outside.
    """
    height, width = products.shape[1:]
    row, column = (winner // width)[:, None, None], (winner % width)[:, None, None]
    dy = torch.arange(height, device=winner.device)[:, None] - row
    dx = torch.arange(width, device=winner.device) - column
    scores = _scores(products, inverse_norms)
    return scores.masked_fill_(dy * dy + dx * dx <= radius_squared, -1.0).amax(dim=(1, 2))


def _scores(products: Tensor, inverse_norms: Tensor) -> Tensor:
    return (products * inverse_norms).nan_to_num_(nan=-1.0).clamp_(-1.0, 1.0)


def inverse_norm(sums: Tensor, h: int, w: int) -> Tensor:
    """Reciprocal norm about the mean of every patch.

    Args:
        sums: (..., 2, H+1, W+1) from :func:`integrals`, or a crop of a larger picture's.
        h: rows of a patch.
        w: columns of a patch.

    Returns:
        (..., H-h+1, W-w+1) float32; 0 where a patch is flat.
    """
    energy, squares = box_energy(sums, h, w), sums[..., 1, :, :]
    floor = FLAT_SHARE * (squares[..., -1:, -1:] - squares[..., :1, :1])  # no less than the window's own energy
    return energy.masked_fill_(energy <= floor, torch.inf).float().rsqrt_()


def correlate(search: Tensor, templates: Tensor) -> Tensor:
    """Cross-correlation by the correlation theorem.

    Args:
        search: (H, W) floating point, or (T, H, W) if every template has its own.
        templates: (T, h, w) of the same dtype.

    Returns:
        (T, H-h+1, W-w+1) sums of products.
    """
    (H, W), (h, w) = search.shape[-2:], templates.shape[-2:]
    rows, columns = fast_length(H), fast_length(W)
    size = (rows, columns)
    count = max(1, _CHUNK_NUMBERS // (2 * rows * (columns // 2 + 1)))
    groups = templates.split(count)
    if search.ndim == 2:
        spectra = [torch.fft.rfft2(search, s=size)] * len(groups)
    else:
        spectra = [torch.fft.rfft2(group, s=size) for group in search.split(count)]
    parts = [
        _inverse(spectrum * torch.fft.rfft2(group, s=size).conj(), H - h + 1, W - w + 1, columns)
        for spectrum, group in zip(spectra, groups, strict=True)
    ]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _inverse(spectrum: Tensor, height: int, width: int, columns: int) -> Tensor:
    """The top-left (height, width) of irfft2, without the transform of the other rows."""
    rows = torch.fft.ifft(spectrum, dim=-2)[..., :height, :]
    picture: Tensor = torch.fft.irfft(rows, n=columns)
    return picture[..., :width]


def integrals(image: Tensor) -> Tensor:
    """Integral images of a picture and of its square.

    Args:
        image: (H, W) floating point.

    Returns:
        (2, H+1, W+1) float64 running sums; the first row and column are 0.
    """
    if image.device.type == "cpu":
        return torch.from_numpy(sums.integrals(image.detach().numpy()))
    wide = torch.nn.functional.pad(image.double(), (1, 0, 1, 0))
    return torch.stack([wide, wide.square()]).cumsum_(-1).cumsum_(-2)


def halved(image: Tensor) -> Tensor:
    """Means of 2 x 2 pixels.

    Args:
        image: (H, W) float32; an odd last row or column is left out.

    Returns:
        (H // 2, W // 2) float32.
    """
    height, width = image.shape[0] & ~1, image.shape[1] & ~1
    return torch.nn.functional.avg_pool2d(image[None, None, :height, :width], 2)[0, 0]


def box_sum(total: Tensor, h: int, w: int) -> Tensor:
    """Sums over every patch.

    Args:
        total: (..., H+1, W+1) running sums, or a crop of a larger picture's.
        h: rows of a patch.
        w: columns of a patch.

    Returns:
        (..., H-h+1, W-w+1).
    """
    return (total[..., h:, w:] - total[..., :-h, w:]).sub_(total[..., h:, :-w]).add_(total[..., :-h, :-w])


def box_energy(sums: Tensor, h: int, w: int) -> Tensor:
    """Sum of squares about the mean of every patch.

    Args:
        sums: (..., 2, H+1, W+1) from :func:`integrals`, or a crop of a larger picture's.
        h: rows of a patch.
        w: columns of a patch.

    Returns:
        (..., H-h+1, W-w+1) float64.
    """
    both = box_sum(sums, h, w)
    total, square = both[..., 0, :, :], both[..., 1, :, :]
    energy: Tensor = square.addcmul_(total, total, value=-1.0 / (h * w))
    return energy
