"""scenematch: position fixes without GNSS, from a downward camera and a georeferenced map.

The public names are those of ``__init__.pyi``.
"""

from engine.runtime.lazy_names import imported_on_use

__all__, __getattr__ = imported_on_use(__name__, __file__)


def __dir__() -> list[str]:
    return __all__
