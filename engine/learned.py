"""Learned matchers: networks of kornia with weights from the user's own file. Nothing is downloaded.

A weights file is opened as tensors only: a pickle that would run code is refused.

Convention:
    Pixel centres are integers, the origin is the centre of the top-left pixel. LoFTR's cells lie on pixels 8x and
    8y, DISK's keypoints on whole pixels. Pictures are padded at the right and at the bottom, which moves no pixel.

References:
    Sun et al., LoFTR: Detector-free local feature matching with transformers, CVPR 2021,
    https://doi.org/10.1109/CVPR46437.2021.00881.
    Tyszkiewicz et al., DISK: Learning local features with policy gradient, NeurIPS 2020.
    Lindenberger et al., LightGlue: Local feature matching at light speed, ICCV 2023,
    https://doi.org/10.1109/ICCV51070.2023.01616.
"""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from engine import device as devices
from engine.errors import DtypeError, OptionError, ShapeError

__all__ = ["DiskLightGlue", "Loftr", "PairMatcher", "load_disk_lightglue", "load_loftr"]

_WRAPPERS = ("state_dict", "extractor", "model")  # under which checkpoints keep their tensors
_DERIVED = ("num_batches_tracked", "confidence_thresholds")  # computed anew where a file lacks them
_LISTED = 3  # names in a message


class PairMatcher(Protocol):
    """Finds the points that two pictures share."""

    def __call__(self, frame: Tensor, crop: Tensor) -> tuple[Tensor, Tensor]:
        """Match two pictures.

        Args:
            frame: (1, 1, H, W) float, values in [0, 1].
            crop: (1, 1, H', W') likewise, of the map.

        Returns:
            The matched points, (M, 2) in the frame's pixels and (M, 2) in the crop's, both (x, y) with centres
            at integers. Row by row they belong together; M may be 0.
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Loftr:
    """LoFTR as a :class:`PairMatcher`; see :func:`load_loftr`.

    Attributes:
        network: takes image0 and image1, gives keypoints0, keypoints1 and confidence.
        min_confidence: matches below it are left out.
    """

    network: nn.Module
    min_confidence: float = 0.5

    def __call__(self, frame: Tensor, crop: Tensor) -> tuple[Tensor, Tensor]:
        """Match two pictures; see :class:`PairMatcher`."""
        _check(frame, crop)
        device = _device_of(self.network)
        with torch.inference_mode():
            images = {"image0": _padded(frame.to(device), 8), "image1": _padded(crop.to(device), 8)}
            found = self.network(images)
            first, second = found["keypoints0"], found["keypoints1"]
            kept = found["confidence"] >= self.min_confidence
            kept &= _inside(first, frame) & _inside(second, crop)
        return first[kept].to(frame.device), second[kept].to(frame.device)


@dataclass(frozen=True, slots=True, eq=False)
class DiskLightGlue:
    """DISK's keypoints matched by LightGlue, as a :class:`PairMatcher`; see :func:`load_disk_lightglue`.

    Attributes:
        disk: kornia's DISK.
        lightglue: kornia's LightGlue for descriptors of 128 numbers.
        max_keypoints: taken from each picture.
    """

    disk: nn.Module
    lightglue: nn.Module
    max_keypoints: int = 2048

    def __call__(self, frame: Tensor, crop: Tensor) -> tuple[Tensor, Tensor]:
        """Match two pictures; see :class:`PairMatcher`."""
        _check(frame, crop)
        device = _device_of(self.disk)
        with torch.inference_mode():
            data = {}
            for name, image in (("image0", frame.to(device)), ("image1", crop.to(device))):
                rgb = image.expand(-1, 3, -1, -1)
                found = self.disk(rgb, n=self.max_keypoints, pad_if_not_divisible=True)[0]
                if len(found.keypoints) < 2:  # LightGlue compares a keypoint with others
                    return frame.new_zeros(0, 2), frame.new_zeros(0, 2)
                size = torch.tensor([[image.shape[3], image.shape[2]]], device=device)
                data[name] = {
                    "keypoints": found.keypoints[None],
                    "descriptors": found.descriptors[None],
                    "image_size": size,
                }
            partner = self.lightglue(data)["matches0"][0]
            matched = partner >= 0
            first = data["image0"]["keypoints"][0][matched]
            second = data["image1"]["keypoints"][0][partner[matched]]
        return first.to(frame.device), second.to(frame.device)


def load_loftr(path: str | Path, *, device: str = "auto", min_confidence: float = 0.5) -> Loftr:
    """Build LoFTR with the weights of a local file.

    Args:
        path: a state dict, or a checkpoint that holds one, for ``kornia.feature.LoFTR``.
        device: "cpu", "cuda" or "auto".
        min_confidence: in [0, 1]; matches below it are left out.

    Raises:
        OptionError: the file is missing, is not one of tensors, or does not fit the network.
        DeviceError: the device is not there.
    """
    from kornia.feature import LoFTR

    if not 0.0 <= min_confidence <= 1.0:
        raise OptionError(f"min_confidence: expected a number in [0, 1], got {min_confidence}")
    network = LoFTR(pretrained=None)
    return Loftr(_filled(network, _tensors(path), path, device), min_confidence)


def load_disk_lightglue(
    disk: str | Path, lightglue: str | Path, *, device: str = "auto", max_keypoints: int = 2048
) -> DiskLightGlue:
    """Build DISK and LightGlue with the weights of two local files.

    Args:
        disk: a state dict, or a checkpoint that holds one, for ``kornia.feature.DISK``.
        lightglue: the same for LightGlue with DISK's descriptors; its published names of layers are understood.
        device: "cpu", "cuda" or "auto".
        max_keypoints: taken from each picture.

    Raises:
        OptionError: a file is missing, is not one of tensors, or does not fit its network.
        DeviceError: the device is not there.
    """
    from kornia.feature import DISK, LightGlue

    if max_keypoints < 2:
        raise OptionError(f"max_keypoints: expected at least 2, got {max_keypoints}")
    detector = _filled(DISK(), _tensors(disk), disk, device)
    unnamed: Any = None  # named features would make kornia fetch their weights
    matcher = LightGlue(features=unnamed, input_dim=128)
    renamed = {_present_name(name): value for name, value in _tensors(lightglue).items()}
    return DiskLightGlue(detector, _filled(matcher, renamed, lightglue, device), max_keypoints)


def _present_name(name: str) -> str:
    """LightGlue's layers were once self_attn.3 and cross_attn.3, and are transformers.3.self_attn now."""
    part, _, rest = name.removeprefix("matcher.").partition(".")
    if part not in ("self_attn", "cross_attn"):
        return name.removeprefix("matcher.")
    layer, _, rest = rest.partition(".")
    return f"transformers.{layer}.{part}.{rest}"


def _tensors(path: str | Path) -> Mapping[str, Tensor]:
    """The tensors of a weights file by name."""
    if not Path(path).is_file():
        raise OptionError(f"weights: no such file: {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        raise OptionError(
            f"weights: {path}: expected tensors alone, got a file that needs code to be run, or is damaged"
        ) from None
    except (OSError, EOFError, RuntimeError, ValueError, LookupError, zipfile.BadZipFile) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise OptionError(f"weights: {path} is not a readable torch file: {reason}") from None
    for wrapper in _WRAPPERS:
        if isinstance(content, dict) and isinstance(content.get(wrapper), dict):
            content = content[wrapper]
    if not isinstance(content, dict) or not content or not all(isinstance(v, Tensor) for v in content.values()):
        raise OptionError(
            f"weights: {path}: expected a state dict, names to tensors, got {type(content).__name__}"
        )
    return content


def _filled(network: nn.Module, tensors: Mapping[str, Tensor], path: str | Path, device: str) -> nn.Module:
    """The network with these weights, ready for inference; every name and shape must fit."""
    target, wanted = devices.resolve(device), network.state_dict()
    lacking = [n for n in wanted if n not in tensors and not n.endswith(_DERIVED)]
    unknown = [n for n in tensors if n not in wanted]
    misshapen = [n for n in wanted if n in tensors and tensors[n].shape != wanted[n].shape]
    faults = [
        f"{what} {_listed(names)}"
        for what, names in (("lacks", lacking), ("has unknown", unknown), ("has other shapes of", misshapen))
        if names
    ]
    if faults:
        raise OptionError(f"weights: {path} does not fit {type(network).__name__}: {'; '.join(faults)}")
    network.load_state_dict(dict(tensors), strict=False)
    return network.to(target).eval().requires_grad_(False)


def _listed(names: list[str]) -> str:
    more = len(names) - _LISTED
    return ", ".join(names[:_LISTED]) + (f" and {more} more" if more > 0 else "")


def _check(frame: Tensor, crop: Tensor) -> None:
    for name, image in (("frame", frame), ("crop", crop)):
        if image.ndim != 4 or image.shape[:2] != (1, 1) or 0 in image.shape:
            raise ShapeError(f"{name}: expected (1, 1, H, W), got {tuple(image.shape)}")
        if not image.is_floating_point():
            raise DtypeError(f"{name}: expected floating point, got {image.dtype}")


def _device_of(network: nn.Module) -> torch.device:
    first = next(network.parameters(), None)
    return torch.device("cpu") if first is None else first.device


def _padded(image: Tensor, multiple: int) -> Tensor:
    """The picture, its edge replicated at the right and at the bottom to whole cells."""
    height, width = image.shape[2:]
    return pad(image, (0, -width % multiple, 0, -height % multiple), mode="replicate")


def _inside(points: Tensor, image: Tensor) -> Tensor:
    """Which points (M, 2) lie on the picture itself."""
    limit = points.new_tensor([image.shape[3] - 0.5, image.shape[2] - 0.5])
    return ((points >= -0.5) & (points <= limit)).all(dim=1)
