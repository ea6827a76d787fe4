"""Learned matchers: networks with weights from the user's own files. Nothing is downloaded.

LoFTR alone, or DISK or ALIKED with LightGlue; :func:`load_matcher` recognises a file by the names of its tensors.
A weights file is opened as tensors only: a pickle that would run code is refused.
"""

from engine.runtime.lazy_names import imported_on_use

__all__, __getattr__ = imported_on_use(__name__, __file__)
