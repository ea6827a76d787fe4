"""Fields of values that hold arrays."""

from dataclasses import fields
from typing import Any


def fields_of(value: Any) -> tuple[Any, ...]:
    """The fields as a tuple, in which the same array is equal to itself.

    From Python 3.13 on a dataclass compares field by field, and two arrays are neither equal nor unequal.
    """
    return tuple(getattr(value, field.name) for field in fields(value))
