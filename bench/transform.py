"""A transform to be trained: grey levels turned into what two years of one place have in common.

A small convolutional network; ``python -m bench.train_transform`` trains it from nothing. The engine does
without it: ``docs/results/seasons.md`` has the comparison.

Reference:
    Fragoso et al., A seasonally invariant deep transform for visual terrain-relative navigation, Science Robotics
    2021, https://doi.org/10.1126/scirobotics.abf3320 (the idea; its network has 1,000 times as many weights).
"""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as nn

Weights = dict[str, Tensor]

SHAPES = {
    "down1": (12, 1, 5, 5),
    "down2": (16, 12, 3, 3),
    "wide1": (16, 16, 3, 3),
    "wide2": (16, 16, 3, 3),
    "side": (12, 16, 1, 1),
    "up1": (12, 12, 3, 3),
    "up2": (4, 12, 3, 3),
}
"""Convolutions as (out, in, rows, columns), each with one bias per output."""
_LIMIT = 4.0  # standard deviations of a neighbourhood, beyond which a level tells no more
_STEP_PX = 4  # the network halves its input twice


def forward(weights: Weights, normal: Tensor) -> Tensor:
    """The network.

    Args:
        weights: by the names of :data:`SHAPES`, and of their biases ``NAME.bias``.
        normal: (B, 1, H, W).

    Returns:
        (B, 1, H, W).
    """

    def convolved(name: str, x: Tensor, stride: int = 1, dilation: int = 1) -> Tensor:
        reach = dilation * (SHAPES[name][-1] // 2)
        return nn.conv2d(x, weights[name], weights[f"{name}.bias"], stride, reach, dilation)

    rows, columns = normal.shape[-2:]
    x = nn.pad(normal.clamp(-_LIMIT, _LIMIT), (0, -columns % _STEP_PX, 0, -rows % _STEP_PX))
    half = convolved("down1", x, stride=2).relu()
    quarter = convolved("down2", half, stride=2).relu()
    quarter = quarter + convolved("wide1", quarter).relu()
    quarter = quarter + convolved("wide2", quarter, dilation=2).relu()
    half = half + nn.interpolate(convolved("side", quarter), scale_factor=2.0, mode="bilinear")
    half = half + convolved("up1", half).relu()
    return nn.pixel_shuffle(convolved("up2", half), 2)[..., :rows, :columns]
