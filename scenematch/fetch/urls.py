"""URLs of servers: check them, and hide their secrets in messages."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, version
from urllib.parse import unquote, urlsplit

from engine.errors import OptionError

PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
"""Placeholders in braces in a URL template."""
_SECRET = re.compile(
    r"key|token|secret|pass|pwd|signature|auth|credential|session|ticket|login|user"
    r"|^(sig|tk|ak|sk|pw|code|gkt|jwt|sid|hmac|(app|client)[-_]?(id|code))$",
    re.IGNORECASE,
)
_PARAMETER = re.compile(r"(?<=[?&#;])([^=?&#;]+)=([^&#;]*)")
_USER = re.compile(r"(?<=://)[^/?#]*@")


def user_agent() -> str:
    """The user agent sent to servers."""
    try:
        return f"scenematch/{version('scenematch-engine')} (map fetch, run by its user)"
    except PackageNotFoundError:  # from a checkout
        return "scenematch (map fetch, run by its user)"


def shown(url: str) -> str:
    """A URL, or text with one, without secrets that must not be printed or stored.

    Secrets are user name, password, and values of query parameters that look like keys. A key in the path cannot
    be recognised and stays.
    """

    def hidden(pair: re.Match[str]) -> str:
        return f"{pair[1]}=..." if _SECRET.search(unquote(pair[1])) else pair[0]

    return _PARAMETER.sub(hidden, _USER.sub("...@", url))


def check_url(argument: str, url: str) -> None:
    """Refuse an invalid web address.

    Raises:
        OptionError: it has another scheme, no host, a password, or invalid characters.
    """
    if any(character <= " " or character == "\x7f" for character in url):
        raise OptionError(f"{argument}: expected a URL without spaces (%20 is one), got {shown(url)!r}")
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError as error:
        raise OptionError(
            f"{argument}: expected a URL with a host and port, got {shown(url)!r} ({error})"
        ) from None
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise OptionError(f"{argument}: expected a URL that begins with https:// or http://, got {shown(url)!r}")
    if "@" in parts.netloc:
        raise OptionError(f"{argument}: expected a URL without user and password in it")
