"""Calls from several threads at once."""

import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def called_at_once(call: Callable[[Any], Any], arguments: Iterable[Any]) -> list[Any]:
    """Answers by four threads that take turns as often as the interpreter lets them."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            return list(pool.map(call, arguments))
    finally:
        sys.setswitchinterval(before)
