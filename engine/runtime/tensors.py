"""torch with the chosen number of threads.

Only this module imports torch; modules that work on tensors import it from here, at the top. Loading torch takes
seconds and 180 MB, and on the CPU NCC and SIFT work on NumPy arrays: their modules import tensor code only if they
have a tensor.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from engine.runtime import threads

__all__ = ["Tensor", "functional", "nn", "torch"]

threads.limit_torch(torch)
