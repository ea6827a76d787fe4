"""A polite HTTP client: one request at a time with pauses, waits as the server asks, and errors in one line."""

from __future__ import annotations

import math
import re
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from http.client import HTTPException, InvalidURL
from importlib.metadata import PackageNotFoundError, version
from urllib.error import HTTPError, URLError
from urllib.parse import unquote, urlsplit
from urllib.request import Request, build_opener, getproxies, proxy_bypass

from engine.errors import MapError, OptionError

ATTEMPTS = 5
"""How often one address is asked before the fetch ends."""
FIRST_WAIT_S = 2.0
"""Before the second attempt, where the server names no time; doubled for each further one."""
MAX_WAIT_S = 300.0
"""A server that asks for a longer wait ends the fetch, which goes on later where it was."""
MAX_BYTES = 128 << 20
PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
"""What stands in braces in a template of addresses."""
_BUSY = (429, 500, 502, 503, 504)
_NO_DATA = (404, 410)
_SECRET = re.compile(
    r"key|token|secret|pass|pwd|signature|auth|credential|session|ticket|login|user"
    r"|^(sig|tk|ak|sk|pw|code|gkt|jwt|sid|hmac|(app|client)[-_]?(id|code))$",
    re.IGNORECASE,
)
_PARAMETER = re.compile(r"(?<=[?&#;])([^=?&#;]+)=([^&#;]*)")
_USER = re.compile(r"(?<=://)[^/?#]*@")


@dataclass(frozen=True, slots=True)
class Answer:
    """What a server sent.

    Attributes:
        content: the bytes.
        kind: its Content-Type, in lower case and without parameters.
    """

    content: bytes
    kind: str


class _AgainError(Exception):
    """The same request may succeed later: after ``wait_s`` where the server names a time."""

    def __init__(self, why: str, wait_s: float | None = None) -> None:
        super().__init__(why)
        self.wait_s = wait_s


def user_agent() -> str:
    """How this product names itself to servers."""
    try:
        return f"scenematch/{version('scenematch-engine')} (map fetch, run by its user)"
    except PackageNotFoundError:  # from a checkout
        return "scenematch (map fetch, run by its user)"


def shown(url: str) -> str:
    """A URL, or text with one, without what must not be printed or stored.

    That is a user's name and password, and values of query parameters that look like keys. A key in the path
    cannot be distinguished from the rest of it, and stays.
    """

    def hidden(pair: re.Match[str]) -> str:
        return f"{pair[1]}=..." if _SECRET.search(unquote(pair[1])) else pair[0]

    return _PARAMETER.sub(hidden, _USER.sub("...@", url))


def check_url(argument: str, url: str) -> None:
    """Refuse what is no web address.

    Raises:
        OptionError: it is of another scheme, has no host, a password in it, or what no URL has.
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


class Client:
    """Asks one address after the other.

    Args:
        pause_ms: between the end of a request and the next one.
        timeout_s: without a byte.
        say: takes one line for a person, when a server has to be waited for.
    """

    def __init__(self, pause_ms: float, timeout_s: float, say: Callable[[str], None]) -> None:
        self._pause_s, self.timeout_s, self._say = pause_ms / 1e3, timeout_s, say
        self._opener = build_opener()  # with the proxies of the environment
        self._ended_s = -math.inf
        self.bytes_received = 0

    def get(self, url: str, first_bytes: int | None = None) -> Answer | None:
        """What is at an address.

        Args:
            url: it.
            first_bytes: read only so many.

        Returns:
            The answer; None where the server says that there is nothing (204, 404, 410).

        Raises:
            MapError: the server refuses, cannot be reached, or is still busy after several attempts.
        """
        for attempt in range(ATTEMPTS):
            time.sleep(max(0.0, self._ended_s + self._pause_s - time.monotonic()))
            try:
                return self._once(url, first_bytes)
            except _AgainError as again:
                wait_s = FIRST_WAIT_S * 2.0**attempt if again.wait_s is None else again.wait_s
                if attempt == ATTEMPTS - 1 or wait_s > MAX_WAIT_S:
                    asked = f", and asks for a wait of {wait_s:.0f} s" if wait_s > MAX_WAIT_S else ""
                    raise MapError(f"{shown(url)}: {again}, at attempt {attempt + 1}{asked}") from None
                self._say(f"{shown(url)}: {again}; waiting {wait_s:.0f} s")
                time.sleep(wait_s)
            finally:
                self._ended_s = time.monotonic()
        raise AssertionError("the last attempt returns or raises")

    def _once(self, url: str, first_bytes: int | None) -> Answer | None:
        headers = {"User-Agent": user_agent(), "Accept": "*/*"}
        if first_bytes is not None:
            headers["Range"] = f"bytes=0-{first_bytes - 1}"
        try:
            with self._opener.open(Request(url, headers=headers), timeout=self.timeout_s) as response:
                if response.status == 204:
                    return None
                content = response.read(MAX_BYTES + 1 if first_bytes is None else first_bytes)
                length = response.headers.get("Content-Length", "")
                kind = response.headers.get_content_type()
        except HTTPError as error:
            with error:
                if error.code in _NO_DATA:
                    return None
                raise self._refusal(url, error) from None
        except URLError as error:
            raise self._unreachable(url, error.reason) from None
        except InvalidURL as error:  # such as one that a server sends to
            raise MapError(f"{shown(url)}: cannot be asked for: {shown(_text(error))}") from None
        except (OSError, HTTPException) as error:
            raise _AgainError(f"the connection broke ({_text(error)})") from None
        except ValueError as error:
            raise MapError(f"{shown(url)}: cannot be asked for: {error}") from None
        self.bytes_received += len(content)
        if len(content) > MAX_BYTES:
            raise MapError(f"{shown(url)}: expected at most {MAX_BYTES >> 20} MB, got more")
        if first_bytes is None and length.isdecimal() and len(content) < int(length):
            raise _AgainError(f"the connection broke after {len(content)} of {length} bytes")
        return Answer(content, kind)

    def _refusal(self, url: str, error: HTTPError) -> Exception:
        """What is raised for a status that is an error."""
        what = f"the server answers {error.code} {error.reason}".rstrip()
        if error.code in _BUSY:
            return _AgainError(what, _retry_after_s(error.headers.get("Retry-After")))
        if error.code in (401, 403):
            what += ": it does not let you in (a key that is missing or wrong, or terms that forbid this)"
        return MapError(f"{shown(url)}: {what}")

    def _unreachable(self, url: str, reason: object) -> Exception:
        """What is raised where no answer came: at once where waiting does not help."""
        host = urlsplit(url).hostname
        proxy = None if proxy_bypass(host or "") else getproxies().get(urlsplit(url).scheme)
        through = f", through the proxy {urlsplit(proxy).hostname}" if proxy else ""
        if isinstance(reason, socket.gaierror):
            return MapError(f"{shown(url)}: the host {host} is unknown, or there is no network{through}")
        if isinstance(reason, TimeoutError):
            return _AgainError(f"no answer within {self.timeout_s:g} s{through}")
        if isinstance(reason, ConnectionRefusedError) or "Tunnel" in str(reason):
            return MapError(f"{shown(url)}: cannot connect to {host}{through} ({_text(reason)})")
        if "CERTIFICATE_VERIFY_FAILED" in str(reason):
            return MapError(f"{shown(url)}: the certificate of {host} is not trusted{through}")
        return _AgainError(f"no connection{through} ({_text(reason)})")


def _text(error: object) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _retry_after_s(text: str | None) -> float | None:
    """Seconds of a Retry-After, which states them or a date; None where it states neither."""
    if text is None:
        return None
    if text.strip().isdecimal():
        return float(text)
    try:
        return max(0.0, parsedate_to_datetime(text).timestamp() - time.time())
    except ValueError:
        return None
