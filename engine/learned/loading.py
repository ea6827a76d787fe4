"""Matchers from weights files."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import kornia.feature as kornia

from engine.errors import OptionError
from engine.learned.keypoints import Extractor, by_aliked, by_disk
from engine.learned.matchers import KeypointMatcher, Loftr
from engine.learned.weights import Weights, fill, read_weights
from engine.runtime import device as devices
from engine.runtime.tensors import nn, torch

_EXPECTED = "LoFTR, or LightGlue with DISK or ALIKED"


def load_matcher(
    paths: Sequence[str | Path],
    *,
    device: str | torch.device = "auto",
    max_keypoints: int = 2048,
    min_confidence: float = 0.5,
) -> KeypointMatcher | Loftr:
    """Build the matcher from its files, in any order.

    Args:
        paths: LoFTR alone, or LightGlue with DISK or ALIKED; state dicts or checkpoints, under the published names
            of their layers or kornia's.
        device: "cpu", "cuda" or "auto".
        max_keypoints: taken from each picture; LoFTR has none.
        min_confidence: of a match by LoFTR, in [0, 1]; LightGlue has a threshold of its own.

    Raises:
        OptionError: a file is missing, holds no tensors or no known network, or does not fit it, or the files do
            not form a matcher.
        DeviceError: the device is not there.
    """
    if max_keypoints < 2:
        raise OptionError(f"max_keypoints: expected at least 2, got {max_keypoints}")
    if not 0.0 <= min_confidence <= 1.0:
        raise OptionError(f"min_confidence: expected a number in [0, 1], got {min_confidence}")
    if not paths:
        raise OptionError(f"weights: expected the files of {_EXPECTED}, got none")
    target = torch.device(devices.resolve(device))
    files = sorted(map(read_weights, paths), key=lambda weights: weights.kind)
    kinds = [weights.kind for weights in files]
    if kinds == ["LoFTR"]:
        return Loftr(fill(kornia.LoFTR(pretrained=None), files[0], target), min_confidence)
    if kinds not in (["ALIKED", "LightGlue"], ["DISK", "LightGlue"]):
        raise OptionError(f"weights: expected the files of {_EXPECTED}, got {' and '.join(kinds)}")
    extractor, numbers = _extractor(files[0], target)
    return KeypointMatcher(extractor, _lightglue(files[1], numbers, target), max_keypoints)


def _extractor(weights: Weights, device: torch.device) -> tuple[Extractor, int]:
    """The extractor of a file, and how many numbers its descriptors have."""
    if weights.kind == "DISK":
        return partial(by_disk, fill(kornia.DISK(), weights, device)), 128
    return partial(by_aliked, _aliked(weights, device)), len(weights.tensors["desc_head.sf_conv.weight"])


def _aliked(weights: Weights, device: torch.device) -> nn.Module:
    """ALIKED in the size of its tensors."""
    if len(weights.tensors["block1.conv1.weight"]) == 8:
        name = "aliked-t16"
    else:
        offsets = weights.tensors.get("desc_head.agg_weights")
        name = "aliked-n32" if offsets is not None and len(offsets) == 32 else "aliked-n16"
    # Without a threshold every local maximum is a keypoint; each call limits their number.
    return fill(kornia.ALIKED(name, max_num_keypoints=1 << 16, detection_threshold=0.0), weights, device)


def _lightglue(weights: Weights, numbers: int, device: torch.device) -> nn.Module:
    """LightGlue for descriptors of this length, with its file's depth.

    Raises:
        OptionError: it is for descriptors of another length, or for keypoints with a scale and an angle.
    """
    tensors = weights.tensors
    projection = tensors.get("input_proj.weight")
    taken = 256 if projection is None else int(projection.shape[-1])
    if tensors["posenc.Wr.weight"].shape[-1] != 2:
        what = "expected LightGlue for DISK or ALIKED, got one whose keypoints have scales or shapes"
        raise OptionError(f"weights: {weights.path}: {what}")
    if taken != numbers:
        what = f"expected LightGlue for descriptors of {numbers} numbers, got one for {taken}"
        raise OptionError(f"weights: {weights.path}: {what}")
    layers = 1 + max(int(n.split(".")[1]) for n in tensors if n.startswith("log_assignment."))
    # For named features kornia would fetch weights.
    network = kornia.LightGlue(features=None, input_dim=numbers, n_layers=layers)  # type: ignore[arg-type]
    return fill(network, weights, device)
