"""What a call says that refuses its input."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from engine.errors import OptionError, TelemetryError


def refusal(call: Callable[..., Any], *arguments: Any, error: type = TelemetryError, **options: Any) -> str:
    """The one line with which a call refuses its input."""
    with pytest.raises(error) as caught:
        call(*arguments, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


misuse = partial(refusal, error=OptionError)
"""The one line with which a call refuses an option."""
