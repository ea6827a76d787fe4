"""Services that describe themselves: their capabilities, their addresses and the format of their pictures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from http.client import HTTPException
from urllib.error import HTTPError, URLError
from urllib.parse import parse_qsl, quote, urlencode, urlsplit, urlunsplit
from urllib.request import Request, urlopen
from xml.etree import ElementTree as Xml

from engine.errors import MapError
from scenematch.fetch.crs import chosen_name
from scenematch.fetch.urls import shown, user_agent

FORMATS = ("image/png", "image/jpeg", "image/webp")
"""Supported formats, best first: PNG is lossless and can be transparent."""
OWN_WORDS = ("service", "request", "version", "layer", "layers", "format", "styles", "crs", "srs")
"""URL parameters set here; others, such as a key, are the user's."""
_ROOTS = ("WMS_Capabilities", "WMT_MS_Capabilities", "Capabilities")  # of WMS 1.3.0, 1.1.1, and WMTS
_STATED = ("Title", "Fees", "AccessConstraints")


def capabilities(url: str, timeout_s: float) -> Xml.Element:
    """The document in which a service describes itself.

    Raises:
        MapError: there is none, or the service is not supported.
    """
    asked = url
    if not url.partition("?")[0].lower().endswith(".xml"):
        service = query_value(url, "service") or ("WMTS" if "wmts" in url.lower() else "WMS")
        asked = with_query(url, {"SERVICE": service.upper(), "REQUEST": "GetCapabilities"})
    try:
        with urlopen(Request(asked, headers={"User-Agent": user_agent()}), timeout=timeout_s) as answer:
            root = Xml.fromstring(answer.read())
    except HTTPError as error:
        with error:
            raise MapError(f"{shown(asked)}: the server answers {error.code} {error.reason}") from None
    except (URLError, OSError, HTTPException, ValueError) as error:
        raise MapError(f"{shown(asked)}: cannot reach it: {shown(str(getattr(error, 'reason', error)))}") from None
    except Xml.ParseError:
        root = None
    if root is None or root.tag.rpartition("}")[2] not in _ROOTS:
        raise MapError(f"{shown(asked)}: expected the capabilities of a WMS or WMTS, got something else")
    return root


def chosen_format(asked: str | None, elements: Iterable[Xml.Element]) -> str:
    """The format of the pictures: the requested one, else the first of :data:`FORMATS`."""
    offered = [(e.text or "").strip() for e in elements]
    readable = [name for name in offered if name.split(";")[0].strip() in FORMATS]
    if asked is None and readable:
        return min(readable, key=lambda name: (FORMATS.index(name.split(";")[0].strip()), len(name)))
    return chosen_name("image_format", asked, readable, "a supported format that the server offers")


def with_query(url: str, values: Mapping[str, str], *, without: Sequence[str] = ()) -> str:
    """A URL with more query parameters; those of the same names, in any case, and ``without`` are removed."""
    parts = urlsplit(url)
    dropped = {name.lower() for name in (*values, *without)}
    kept = [pair for pair in parse_qsl(parts.query, keep_blank_values=True) if pair[0].lower() not in dropped]
    return urlunsplit(
        parts._replace(query=urlencode([*kept, *values.items()], safe=":,/", quote_via=quote), fragment="")
    )


def query_value(url: str, name: str) -> str | None:
    """The value of a query parameter, by its name in any case; None if it is missing or empty."""
    return next((value for key, value in parse_qsl(urlsplit(url).query) if key.lower() == name.lower()), None)


def text_of(element: Xml.Element, tag: str) -> str:
    """A child's text in one line, empty if there is none."""
    return " ".join((element.findtext(f"{{*}}{tag}") or "").split())


def stated(service: Xml.Element | None) -> dict[str, str]:
    """A service's statements about itself and its terms of use."""
    return {} if service is None else {name: text for name in _STATED if (text := text_of(service, name))}
