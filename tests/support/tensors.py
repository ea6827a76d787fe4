"""Tensors compared."""

import numpy as np
from torch import Tensor


def assert_close(found: Tensor, expected: Tensor, *, rtol: float = 1.3e-6, atol: float = 1e-5) -> None:
    """As torch has it for float32, whose own first loads its distributed tensors: more than a second a process."""
    assert (found.dtype, found.shape, found.device) == (expected.dtype, expected.shape, expected.device)
    arrays = (tensor.detach().numpy() for tensor in (found, expected))
    np.testing.assert_allclose(*arrays, rtol=rtol, atol=atol, equal_nan=False)
