"""Normalise and find the peak in one pass by Triton: the normalised surface is never written.

Every program reduces one block of one surface to its best score and index; torch reduces over the blocks. The
plain torch versions of the same names are in :mod:`engine.kernels.eager`, and agree bit for bit.
"""

from __future__ import annotations

import triton
import triton.language as tl

from engine.runtime.tensors import Tensor, torch

_BLOCK = 2048
# Sizes, strides and offsets of views change with the window; specialising on them would compile in flight.
_STRIDES = ("template_stride", "row_stride", "norm_template_stride", "norm_stride")
_SIZES = ("count", "width", *_STRIDES, "radius_squared")
_VIEWS = ("products", "inverse_norms", "winner")


@triton.jit(do_not_specialize=_SIZES, do_not_specialize_on_alignment=_VIEWS)
def _block_peaks(
    products,
    inverse_norms,
    winner,  # or None: no disc is excluded
    best,
    indices,
    count: tl.int64,
    width: tl.int32,
    template_stride: tl.int64,
    row_stride: tl.int64,
    norm_template_stride: tl.int64,
    norm_stride: tl.int64,
    radius_squared: tl.int64,
    BLOCK: tl.constexpr,
):
    """Best score in ``BLOCK`` positions of one template's surface, and the lowest index that has it."""
    block, template = tl.program_id(0), tl.program_id(1).to(tl.int64)
    lanes = tl.arange(0, BLOCK)
    first = block.to(tl.int64) * BLOCK
    row = first // width
    along = (first - row * width).to(tl.int32) + lanes  # columns, counted on past the end of the block's first row
    y, x = row + along // width, along % width
    inside = first + lanes < count
    product = tl.load(products + template * template_stride + y * row_stride + x, mask=inside, other=0.0)
    norm = tl.load(inverse_norms + template * norm_template_stride + y * norm_stride + x, mask=inside, other=0.0)
    score = product * norm
    score = tl.where(score > -1.0, score, -1.0)  # NaN becomes -1; tl.maximum keeps it in Triton 3.7's interpreter
    score = tl.minimum(score, 1.0)
    if winner is not None:
        middle = tl.load(winner + template)
        dy, dx = y - middle // width, x - middle % width
        score = tl.where(dy * dy + dx * dx > radius_squared, score, -1.0)
    score = tl.where(inside, score, -2.0)  # below every score
    top, lane = tl.max(score, axis=0, return_indices=True)
    out = template * tl.num_programs(0) + block
    tl.store(best + out, top)
    tl.store(indices + out, first + lane)


def peak(products: Tensor, inverse_norms: Tensor) -> tuple[Tensor, Tensor]:
    """Maximum of every template's surface.

    Args:
        products: (T, H', W') float32 numerators.
        inverse_norms: (H', W') float32, or (T, H', W').

    Returns:
        Score (T,) and flat index (T,) int64 in (H', W'), the lowest of equal ones.
    """
    best, indices = _launch(products, inverse_norms, None, 0)
    block = best.argmax(dim=1, keepdim=True)  # the first of equal ones; blocks are in the order of indices
    return best.gather(1, block)[:, 0], indices.gather(1, block)[:, 0]


def rival(products: Tensor, inverse_norms: Tensor, winner: Tensor, radius_squared: int) -> Tensor:
    """Maximum of every template's surface outside a disc.

    Args:
        products: (T, H', W') float32 numerators.
        inverse_norms: (H', W') float32, or (T, H', W').
        winner: (T,) int64, the flat index of the disc's centre, on the device.
        radius_squared: positions of at most this squared distance are inside, in squared pixels.

    Returns:
        (T,) float32; -1 where nothing is outside.
    """
    return _launch(products, inverse_norms, winner, radius_squared)[0].amax(dim=1)


def _launch(
    products: Tensor, inverse_norms: Tensor, winner: Tensor | None, radius_squared: int
) -> tuple[Tensor, Tensor]:
    """Best scores and their flat indices by block, (T, blocks) each."""
    templates, height, width = products.shape
    count = height * width
    products, inverse_norms = _with_dense_rows(products), _with_dense_rows(inverse_norms).expand(products.shape)
    winner = None if winner is None else winner.contiguous()
    blocks = triton.cdiv(count, _BLOCK)
    best = torch.empty((templates, blocks), dtype=torch.float32, device=products.device)
    indices = torch.empty((templates, blocks), dtype=torch.int64, device=products.device)
    _block_peaks[(blocks, templates)](
        products,
        inverse_norms,
        winner,
        best,
        indices,
        count,
        width,
        products.stride(0),
        products.stride(1),
        inverse_norms.stride(0),
        inverse_norms.stride(1),
        radius_squared,
        BLOCK=_BLOCK,
        enable_fp_fusion=False,  # every rounding is torch's own
    )
    return best, indices


def _with_dense_rows(tensor: Tensor) -> Tensor:
    """The tensor, or a copy where neighbours in a row are not neighbours in memory."""
    return tensor if tensor.stride(-1) == 1 else tensor.contiguous()
