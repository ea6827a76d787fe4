"""What a fetch of a map refuses or must not repeat: one clear line, and nothing of the user's is lost."""

import re
from xml.etree import ElementTree as Xml

import pytest
from pyproj import CRS

from engine.errors import OptionError
from scenematch.fetch.crs import chosen_crs
from scenematch.fetch.grid import Place
from scenematch.fetch.heights import files_for
from scenematch.fetch.urls import shown
from scenematch.fetch.wmts import _extra_query
from scenematch.runs.map_fetch import FetchSettings, fetch_map
from tests.support.refusals import misuse

TILES = "http://127.0.0.1:9/{z}/{x}/{y}.png"  # nobody listens there


def settings(source=TILES, around="48.246,16.5245", **others):
    return FetchSettings(around=around, source=source, radius_m=50.0, pause_ms=0.0, timeout_s=60.0, **others)


@pytest.mark.parametrize(
    "surface", ["s-surface.tif", "s.tif", "sub/../s-surface.tif", "link.tif", "{lat}_{lon}.tif"]
)
def test_the_users_own_surface_is_never_replaced_by_a_part_of_it(tmp_path, surface):
    (tmp_path / "sub").mkdir()
    for name in ("s.tif", "s-surface.tif"):
        (tmp_path / name).write_bytes(b"the user's own")
    (tmp_path / "link.tif").symlink_to(tmp_path / "s-surface.tif")
    (tmp_path / "N48_E016.tif").hardlink_to(tmp_path / "s.tif")
    with pytest.raises(OptionError, match=r"out: .* is also the input `surface`; choose another file"):
        fetch_map(settings(surface=str(tmp_path / surface), force=True), tmp_path / "s.tif")
    assert all(path.read_bytes() == b"the user's own" for path in tmp_path.glob("*.tif"))


# ------------------------------------------------------------ keys


@pytest.mark.parametrize(
    "name",
    ["key", "apikey", "api_key", "access_token",
     "X-Amz-Signature", "tk", "ak", "sk", "pwd", "appid", "app_id", "app_code", "ticket", "login",
     "user", "pass", "sig", "access%5Ftoken", "client_id", "jwt"],
)  # fmt: skip
def test_what_looks_like_a_key_is_hidden(name):
    url = f"https://a.org/wms?map=/x.map&{name}=S3CRET&layers=o"
    assert shown(url) == f"https://a.org/wms?map=/x.map&{name}=...&layers=o"


def test_what_is_no_key_stays():
    url = "https://a.org/wms?map=/x.map&layers=o&styles=&format=image/png&bbox=1,2,3,4&time=2024&z={z}"
    assert shown(url) == url
    assert shown("https://me:word@a.org/x?y=1") == "https://...@a.org/x?y=1"


PLACEHOLDERS, SCHEMES = "expected {z}, {x} and {y} (or {-y}), or {q}", "begins with https:// or http://"


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("ftp://me:S3CRET@example.org/{z}/{x}/{y}.png", "expected"),
        ("ftp://example.org/{z}/{x}/{y}.png?key=S3CRET", SCHEMES),
        ("map.tif", SCHEMES),
        ("https://example.org/{z}/{x}.png?key=S3CRET", PLACEHOLDERS),
        ("https://{s}.example.org/{z}/{x}/{y}.png?tk=S3CRET", PLACEHOLDERS),
        ("https://me:S3CRET@example.org/wms", "without user and password"),
        ("https://example.org/{z}/{x}/{y}.png?tk=S3 CRET", "expected"),
        ("http://[::1/{z}/{x}/{y}.png?tk=S3CRET", "expected a URL "),
        ("http://h:abc/{z}/{x}/{y}.png?tk=S3CRET", "expected a URL "),
        ("http://h:99999/{z}/{x}/{y}.png?tk=S3CRET", "expected a URL "),
        ("http://h/{z}/{x}/{y}.png?tk=S3CRET\n", "expected a URL "),
    ],
)
def test_refusals_name_the_source_and_do_not_repeat_keys(tmp_path, source, words):
    with pytest.raises(OptionError, match=rf"^source: .*{re.escape(words)}") as error:
        fetch_map(settings(source), tmp_path / "map.tif")
    assert not re.search("S3|CRET|\n", str(error.value))


@pytest.mark.parametrize(
    "surface",
    ["http://h/{lat}_{lon}}.tif", "d/{{lat}_{lon}.tif", "d/{lat}{lon}{.tif", "https://h/{lat}.tif?key=S3CRET"],
)
def test_nor_do_those_of_heights_with_stray_braces(surface):
    message = misuse(files_for, surface, (0.0, 0.0, 1.0, 1.0))
    assert message.startswith("surface: expected {lat} and {lon} as placeholders, or none")
    assert "S3CRET" not in message


# ------------------------------------------------------------ where the Earth's grids end


@pytest.mark.parametrize("around", ["0,180", "0,-180", "10,179.9999", "-60,-179.9999"])
def test_a_square_across_the_antimeridian_is_refused(tmp_path, around):
    with pytest.raises(OptionError, match="around: expected a square that does not cross 180 degrees east, got "):
        fetch_map(settings(around=around, dry_run=True), tmp_path / "map.tif")


def test_a_square_beside_it_is_not(tmp_path):
    assert fetch_map(settings(around="0,179.99", dry_run=True), tmp_path / "map.tif")["tiles"] < 10
    assert Place(0.0, 179.99, 50.0).bounds(CRS.from_epsg(4326))[2] < 180.0


# ------------------------------------------------------------ coordinate systems and addresses that servers state


def test_only_a_coordinate_system_for_the_place_is_chosen():
    vienna = Place(48.2, 16.4, 50.0)
    assert chosen_crs(None, ["EPSG:2154", "EPSG:31256", "EPSG:4326"], vienna) == "EPSG:31256"
    assert chosen_crs(None, ["EPSG:2154", "EPSG:999999", "EPSG:4326"], vienna) == "EPSG:4326"
    assert chosen_crs("EPSG:2154", ["EPSG:2154"], vienna) == "EPSG:2154"  # as asked
    assert chosen_crs(None, ["urn:ogc:def:crs", "EPSG:31256"], vienna) == "EPSG:31256"  # one that names none
    with pytest.raises(OptionError, match=r"crs: expected one for 48.2,16.4 .*, got EPSG:2154"):
        chosen_crs(None, ["EPSG:2154"], vienna)
    for lon_deg in (179.0, -179.0):  # its area crosses 180 degrees
        assert chosen_crs(None, ["EPSG:3832"], Place(-17.0, lon_deg, 50.0)) == "EPSG:3832"


@pytest.mark.parametrize(
    ("href", "sent"),
    [("https://a.org/tiles?map=m", "key=S3CRET"), ("/kvp", "key=S3CRET"), ("https://b.org/tiles", "")],
)
def test_a_key_is_sent_to_the_host_that_was_named_and_to_no_other(href, sent):
    text = (
        '<C xmlns:xlink="http://www.w3.org/1999/xlink"><Operation name="GetTile"><DCP><HTTP>'
        f'<Get xlink:href="{href}"/></HTTP></DCP></Operation></C>'
    )
    assert _extra_query(Xml.fromstring(text), "https://a.org/caps.xml?key=S3CRET&Service=WMTS") == sent
