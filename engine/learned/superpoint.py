"""SuperPoint: a network that detects and describes keypoints, with the published names of its layers.

References:
    DeTone, Malisiewicz and Rabinovich, SuperPoint: Self-supervised interest point detection and description,
    CVPR workshops 2018, https://doi.org/10.1109/CVPRW.2018.00060.
"""

from __future__ import annotations

from engine.runtime.tensors import Tensor, functional, nn, torch

CELL_PX = 8
"""Side of the cell of pixels that shares one descriptor, and in which the detector chooses at most one place."""
_CLEAR_PX = 4
"""A keypoint nearer to the edge is only partly visible; of several nearer to each other the strongest stays."""
_MIN_SCORE = 0.0005  # LightGlue's


class SuperPoint(nn.Module):
    """The network; its pictures are of whole cells.

    Convention:
        The middle of cell (i, j) lies on pixel (8 i + 3.5, 8 j + 3.5); keypoints lie on whole pixels.
    """

    def __init__(self) -> None:
        super().__init__()
        channels = (1, 64, 64, 128, 128)
        for block in range(4):
            first, last = channels[block], channels[block + 1]
            setattr(self, f"conv{block + 1}a", nn.Conv2d(first, last, 3, padding=1))
            setattr(self, f"conv{block + 1}b", nn.Conv2d(last, last, 3, padding=1))
        self.convPa, self.convPb = nn.Conv2d(128, 256, 3, padding=1), nn.Conv2d(256, CELL_PX**2 + 1, 1)
        self.convDa, self.convDb = nn.Conv2d(128, 256, 3, padding=1), nn.Conv2d(256, 256, 1)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoint probabilities and descriptors of pictures.

        Args:
            images: (B, 1, H, W), H and W multiples of 8, values in [0, 1].

        Returns:
            (B, H, W) probability of a keypoint, and (B, 256, H / 8, W / 8) descriptors of unit length.
        """
        x = images
        for block in range(1, 5):
            if block > 1:
                x = functional.max_pool2d(x, 2)
            x = functional.relu(getattr(self, f"conv{block}a")(x))
            x = functional.relu(getattr(self, f"conv{block}b")(x))
        logits = self.convPb(functional.relu(self.convPa(x)))
        places = torch.softmax(logits, dim=1)[:, :-1]  # the last is "no keypoint"
        scores = functional.pixel_shuffle(places, CELL_PX)[:, 0]
        return scores, functional.normalize(self.convDb(functional.relu(self.convDa(x))), dim=1)


def strongest(scores: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The strongest places of a score map.

    Args:
        scores: (H, W), probabilities.
        count: upper bound on the places.

    Returns:
        (N, 2) whole pixels (x, y) and (N,) their scores, falling.
    """
    side = 2 * _CLEAR_PX + 1
    highest = functional.max_pool2d(scores[None, None], side, stride=1, padding=_CLEAR_PX)[0, 0]
    kept = (scores == highest) & (scores > _MIN_SCORE)
    kept[:_CLEAR_PX], kept[-_CLEAR_PX:], kept[:, :_CLEAR_PX], kept[:, -_CLEAR_PX:] = (False,) * 4
    y, x = torch.nonzero(kept, as_tuple=True)
    found = scores[y, x]
    order = found.argsort(descending=True)[:count]
    return torch.stack([x[order], y[order]], dim=1).to(scores.dtype), found[order]


def sample(descriptors: Tensor, xy_px: Tensor) -> Tensor:
    """The descriptors at pixels, bilinear between the cells' middles.

    Args:
        descriptors: (256, h, w), one a cell.
        xy_px: (N, 2).

    Returns:
        (N, 256) of unit length.
    """
    cells = (xy_px - (CELL_PX - 1) / 2) / CELL_PX
    last = xy_px.new_tensor([descriptors.shape[2] - 1, descriptors.shape[1] - 1]).clamp(min=1)
    at = (2.0 * cells / last - 1.0)[None, None]
    found = functional.grid_sample(descriptors[None], at, padding_mode="border", align_corners=True)[0, :, 0]
    return functional.normalize(found.T, dim=1)
