"""Weights files: read as tensors only, recognised by the names of their tensors, and checked against a network."""

from __future__ import annotations

import pickle
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from engine.errors import OptionError
from engine.runtime.tensors import Tensor, nn, torch

KINDS = {
    "DISK": ("unet.path_down.0.1.3.weight",),
    "ALIKED": ("block1.conv1.weight", "score_head.0.weight", "desc_head.sf_conv.weight"),
    "LightGlue": ("posenc.Wr.weight", "log_assignment.0.final_proj.weight"),
    "LoFTR": ("backbone.conv1.weight", "loftr_coarse.layers.0.q_proj.weight"),
}
"""Tensors by which each network's file is recognised."""
_WRAPPERS = ("state_dict", "extractor", "model")  # keys under which checkpoints keep their tensors
# Recomputed if a file lacks them.
_DERIVED = ("num_batches_tracked", "confidence_thresholds", "dkd.hw_grid")
# Training leftovers in published files, not used for inference.
_UNUSED = re.compile(r"log_assignment\.\d+\.r|.*num_batches_tracked|confidence_thresholds")


@dataclass(frozen=True, slots=True)
class Weights:
    """The tensors of one file.

    Attributes:
        path: of the file.
        kind: of :data:`KINDS`.
        tensors: by the names that the networks have now.
    """

    path: Path
    kind: str
    tensors: Mapping[str, Tensor]


def read_weights(path: str | Path) -> Weights:
    """Read a file of tensors.

    Args:
        path: a state dict, or a checkpoint that holds one.

    Raises:
        OptionError: the file is missing, contains more than tensors, or holds no known network.
    """
    tensors = {_present_name(name): value for name, value in _read(path).items()}
    kind = next((kind for kind, names in KINDS.items() if all(name in tensors for name in names)), None)
    if kind is None:
        some = ", ".join(sorted(tensors)[:2])
        raise OptionError(f"weights: {Path(path)}: expected {', '.join(KINDS)}, got tensors named {some}")
    return Weights(Path(path), kind, tensors)


def fill(network: nn.Module, weights: Weights, device: torch.device) -> nn.Module:
    """The network with these weights, ready for inference; every name and shape must fit.

    Raises:
        OptionError: they do not fit.
    """
    wanted, tensors = network.state_dict(), weights.tensors
    named = {
        "lacks": [n for n in wanted if n not in tensors and not n.endswith(_DERIVED)],
        "has unknown": [n for n in tensors if n not in wanted and not _UNUSED.fullmatch(n)],
        "has other shapes of": [n for n in wanted if n in tensors and tensors[n].shape != wanted[n].shape],
    }
    faults = "; ".join(f"{fault} {_listed(names)}" for fault, names in named.items() if names)
    if faults:
        raise OptionError(f"weights: {weights.path} does not fit {type(network).__name__}: {faults}")
    network.load_state_dict(dict(tensors), strict=False)
    return network.to(device).eval().requires_grad_(False)


def _present_name(name: str) -> str:
    """Rename LightGlue's old layers, self_attn.3 and cross_attn.3, to transformers.3.self_attn and so on."""
    name = name.removeprefix("matcher.")
    part, _, rest = name.partition(".")
    if part not in ("self_attn", "cross_attn"):
        return name
    layer, _, rest = rest.partition(".")
    return f"transformers.{layer}.{part}.{rest}"


def _read(path: str | Path) -> Mapping[str, Tensor]:
    """The tensors of a file by the file's names."""
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


def _listed(names: list[str]) -> str:
    return names[0] + (f" and {len(names) - 1} more" if len(names) > 1 else "")
