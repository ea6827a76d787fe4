"""A pretended device: tensors that say they are elsewhere, hold real values, and count what crosses.

On a machine without a GPU ``.cpu()`` does nothing that could be counted. Tensors of this device are wrappers about
tensors of the CPU: every operation runs there, and answers are real, while code that asks where a tensor lives is
sent elsewhere and takes its path for GPUs. What would copy to the host, or make the host wait because a shape
depends on values, is recorded; what CUDA refuses (operands on two devices) is refused.

The device is called "meta", since torch without CUDA makes no tensor that says "cuda".
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = torch.device("meta")
_aten = torch.ops.aten
# The host waits for these: they return a number, or their shape depends on values.
_WAITS = {
    _aten._local_scalar_dense, _aten.equal, _aten.nonzero, _aten.masked_select, _aten._unique2, _aten.unique_dim,
    _aten.unique_consecutive, _aten.bincount, _aten.histc,
}  # fmt: skip
_INDEXED = {_aten.index, _aten.index_put, _aten.index_put_, _aten._index_put_impl_}
_COPIES = {_aten._to_copy, _aten.copy_}


class Pretended(Tensor):
    """A tensor of the pretended device; ``inner`` holds its values."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> Pretended:
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset()}
        made = Tensor._make_wrapper_subclass(cls, inner.size(), **layout, dtype=inner.dtype, device=DEVICE)
        made.inner = inner
        return made

    def __repr__(self, *args: Any, **kwargs: Any) -> str:
        return f"Pretended({tuple(self.shape)}, {self.dtype})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise RuntimeError(f"{func}: expected inside pretended_device()")


class Crossings(TorchDispatchMode):
    """What crossed between the host and the pretended device.

    Attributes:
        uploads: numbers per copy to the device.
        downloads: numbers per copy to the host.
        waits: operations that the host waits for.
    """

    def __init__(self) -> None:
        super().__init__()
        self.uploads: list[int] = []
        self.downloads: list[int] = []
        self.waits: list[str] = []

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing is compiled here: torch loads no compiler (two seconds) and steps around it at no operation."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        given = _tensors((args, kwargs))
        mine = [leaf for leaf in given if isinstance(leaf, Pretended)]
        on_device = bool(mine)
        if kwargs.get("device") is not None:
            on_device = torch.device(kwargs["device"]) == DEVICE
            kwargs["device"] = torch.device("cpu")
        packet = func.overloadpacket
        if packet is _aten.copy_:
            on_device = isinstance(args[0], Pretended)
        if mine or on_device:
            self._record(func, args, given, mine, on_device)
        # A lazy conjugate is resolved above this level: here it would be lost.
        func = _aten.conj_physical.default if packet is _aten._conj else func
        out = func(*_mapped(args, Pretended, _inner), **_mapped(kwargs, Pretended, _inner))
        if not on_device:
            return out
        return _mapped(out, Tensor, lambda t: _wrapped(t, mine))

    def _record(self, func: Any, args: Any, given: list[Tensor], mine: list[Any], on_device: bool) -> None:
        packet = func.overloadpacket
        if packet in _COPIES:
            source = args[1] if packet is _aten.copy_ else args[0]
            if on_device and not isinstance(source, Pretended):
                self.uploads.append(source.numel())
            elif not on_device:
                self.downloads.append(source.numel())
            return
        if packet in _WAITS:
            self.waits.append(str(func))
        others = [t for t in given if not isinstance(t, Pretended) and t.ndim]
        if packet in _INDEXED:
            indices = _tensors(args[1])
            if any(t.dtype in (torch.bool, torch.uint8) for t in indices):
                self.waits.append(str(func))  # by way of nonzero
            if isinstance(args[0], Pretended):
                uploaded = [t for t in indices if not isinstance(t, Pretended)]
                self.uploads += [t.numel() for t in uploaded]
                others = [t for t in others if all(t is not u for u in uploaded)]
        if mine and others:
            shapes = [t.shape for t in others]
            raise RuntimeError(f"{func}: expected all tensors on one device, got {shapes} on cpu")


# Arguments and results of an operation are tensors, numbers, and lists, tuples and dictionaries of them: the trees
# of torch, which know more, took a third of the tests' time.


def _tensors(tree: Any) -> list[Tensor]:
    """The tensors of it, in order."""
    if isinstance(tree, Tensor):
        return [tree]
    if not isinstance(tree, list | tuple | dict):
        return []
    return [t for part in (tree.values() if isinstance(tree, dict) else tree) for t in _tensors(part)]


def _mapped(tree: Any, kind: type, change: Callable[[Any], Any]) -> Any:
    """The same with every value of a kind changed."""
    if isinstance(tree, kind):
        return change(tree)
    if isinstance(tree, dict):
        return {name: _mapped(part, kind, change) for name, part in tree.items()}
    if isinstance(tree, list | tuple):
        return type(tree)([_mapped(part, kind, change) for part in tree])
    return tree


def _inner(tensor: Pretended) -> Tensor:
    return tensor.inner


def _wrapped(out: Tensor, given: list[Any]) -> Pretended:
    """The wrapper of a result; the operand's own where the operation worked in place."""
    own = [t for t in given if t.inner is out]
    return own[0] if own else Pretended(out)


@contextmanager
def pretended_device() -> Iterator[Crossings]:
    """The block in which tensors of :data:`DEVICE` can be made and used, and its record."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "inference_mode", torch.no_grad)  # which wrappers cannot follow; the values are equal
        made = torch.tensor

        def tensor(data: Any, *, device: Any = None, **kind: Any) -> Tensor:
            there = made(data, **kind)  # torch itself would make one without values
            return there if device is None else there.to(device)

        def new_tensor(like: Tensor, data: Any, **kind: Any) -> Tensor:
            return tensor(data, device=like.device, **({"dtype": like.dtype} | kind))

        patch.setattr(torch, "tensor", tensor)
        patch.setattr(Tensor, "new_tensor", new_tensor)
        with Crossings() as crossings:
            yield crossings
