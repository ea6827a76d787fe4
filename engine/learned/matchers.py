"""Matchers of two pictures: LoFTR, and LightGlue on the keypoints of an extractor.

Convention:
    Pixel centres are integers, the origin is the centre of the top-left pixel. LoFTR's cells lie on pixels 8x and
    8y. Pictures are padded at the right and at the bottom, which moves no pixel.

References:
    Sun et al., LoFTR: Detector-free local feature matching with transformers, CVPR 2021,
    https://doi.org/10.1109/CVPR46437.2021.00881.
    Lindenberger et al., LightGlue: Local feature matching at light speed, ICCV 2023,
    https://doi.org/10.1109/ICCV51070.2023.01616.
"""

from __future__ import annotations

from dataclasses import dataclass

from engine.errors import DtypeError, ShapeError
from engine.learned.keypoints import Extractor, Keypoints
from engine.runtime.tensors import Tensor, functional, nn, torch


@dataclass(frozen=True, slots=True, eq=False)
class Loftr:
    """LoFTR as a :class:`engine.learned.PairMatcher`; see :func:`engine.learned.load_matcher`.

    Attributes:
        network: takes image0 and image1, gives keypoints0, keypoints1 and confidence.
        min_confidence: matches below it are left out.
    """

    network: nn.Module
    min_confidence: float

    def __call__(self, frame: Tensor, crop: Tensor) -> tuple[Tensor, Tensor]:
        """Match two pictures; see :class:`engine.learned.PairMatcher`."""
        _check(frame, crop)
        device = next(self.network.parameters()).device
        with torch.inference_mode():
            images = {"image0": _padded(frame.to(device)), "image1": _padded(crop.to(device))}
            found = self.network(images)
            first, second = found["keypoints0"], found["keypoints1"]
            kept = found["confidence"] >= self.min_confidence
            kept &= _inside(first, frame) & _inside(second, crop)
        return first[kept].to(frame.device), second[kept].to(frame.device)


@dataclass(frozen=True, slots=True, eq=False)
class KeypointMatcher:
    """A :class:`engine.learned.PairMatcher` of keypoints by LightGlue; see :func:`engine.learned.load_matcher`.

    Attributes:
        extractor: finds the keypoints of a picture.
        lightglue: kornia's LightGlue for the extractor's descriptors.
        max_keypoints: taken from each picture.
    """

    extractor: Extractor
    lightglue: nn.Module
    max_keypoints: int

    def __call__(self, frame: Tensor, crop: Tensor) -> tuple[Tensor, Tensor]:
        """Match two pictures; see :class:`engine.learned.PairMatcher`."""
        _check(frame, crop)
        first, second = (self.extract(image, self.max_keypoints) for image in (frame, crop))
        pairs = self.match(first, _size(frame), second, _size(crop)).to(frame.device)
        return first.xy_px.to(frame.device)[pairs[:, 0]], second.xy_px.to(frame.device)[pairs[:, 1]]

    def extract(self, picture: Tensor, count: int) -> Keypoints:
        """The strongest keypoints of a picture (1, 1, H, W), on the network's device."""
        with torch.inference_mode():
            return self.extractor(picture.to(next(self.lightglue.parameters()).device), count)

    def match(
        self, first: Keypoints, first_size_px: tuple[int, int], second: Keypoints, second_size_px: tuple[int, int]
    ) -> Tensor:
        """Match the keypoints of two pictures.

        Args:
            first: of one picture.
            first_size_px: its width and height.
            second: of the other.
            second_size_px: its width and height.

        Returns:
            (M, 2) indices into both.
        """
        device = next(self.lightglue.parameters()).device
        if min(len(first), len(second)) < 2:  # LightGlue compares a keypoint with others
            return torch.zeros(0, 2, dtype=torch.long, device=device)
        data = {
            f"image{i}": {
                "keypoints": points.xy_px[None].to(device),
                "descriptors": points.descriptors[None].to(device),
                "image_size": torch.tensor([size_px], device=device),
            }
            for i, (points, size_px) in enumerate(((first, first_size_px), (second, second_size_px)))
        }
        with torch.inference_mode():
            partner = self.lightglue(data)["matches0"][0]
        matched = torch.nonzero(partner >= 0)[:, 0]
        return torch.stack([matched, partner[matched]], dim=1)


def _padded(picture: Tensor) -> Tensor:
    """The picture, padded at the right and bottom to LoFTR's cells of 8 pixels by replicating its edge."""
    height, width = picture.shape[2:]
    return functional.pad(picture, (0, -width % 8, 0, -height % 8), mode="replicate")


def _size(image: Tensor) -> tuple[int, int]:
    """Width and height."""
    return int(image.shape[3]), int(image.shape[2])


def _check(frame: Tensor, crop: Tensor) -> None:
    for name, image in (("frame", frame), ("crop", crop)):
        if image.ndim != 4 or image.shape[:2] != (1, 1) or 0 in image.shape:
            raise ShapeError(f"{name}: expected (1, 1, H, W), got {tuple(image.shape)}")
        if not image.is_floating_point():
            raise DtypeError(f"{name}: expected floating point, got {image.dtype}")


def _inside(points: Tensor, image: Tensor) -> Tensor:
    """Which points (M, 2) lie on the picture itself."""
    limit = points.new_tensor([image.shape[3] - 0.5, image.shape[2] - 0.5])
    return ((points >= -0.5) & (points <= limit)).all(dim=1)
