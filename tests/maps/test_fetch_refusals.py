"""What a fetch of a map refuses or must not repeat: one clear line, and nothing of the user's is lost."""

import re
import socket
import threading
import time
from http.client import HTTPException

import pytest
from pyproj import CRS

from engine.errors import MapError, OptionError
from engine.maps.fetching import client
from engine.maps.fetching.client import Client, check_url, shown
from engine.maps.fetching.heights import files_for, read_part
from engine.maps.fetching.mosaic import Place
from engine.runs.map_fetch import FetchSettings, fetch_map

TILES = "http://127.0.0.1:9/{z}/{x}/{y}.png"  # nobody listens there


def settings(source=TILES, around="48.246,16.5245", **others):
    return FetchSettings(around=around, source=source, radius_m=50.0, pause_ms=0.0, timeout_s=1.0, **others)


@pytest.mark.parametrize(
    "surface", ["s-surface.tif", "s.tif", "sub/../s-surface.tif", "link.tif", "{lat}_{lon}.tif"]
)
def test_the_users_own_surface_is_never_replaced_by_a_part_of_it(tmp_path, surface):
    (tmp_path / "sub").mkdir()
    for name in ("s.tif", "s-surface.tif"):
        (tmp_path / name).write_bytes(b"the user's own")
    (tmp_path / "link.tif").symlink_to(tmp_path / "s-surface.tif")
    (tmp_path / "N48_E016.tif").hardlink_to(tmp_path / "s.tif")
    with pytest.raises(OptionError, match=r"out: .* is the `surface` that is read; choose another file"):
        fetch_map(settings(surface=str(tmp_path / surface), force=True), tmp_path / "s.tif")
    assert all(path.read_bytes() == b"the user's own" for path in tmp_path.glob("*.tif"))


def test_a_refusal_leaves_no_empty_folder(tmp_path):
    with pytest.raises(MapError, match="cannot connect"):
        fetch_map(settings(), tmp_path / "map.tif")
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------ keys


@pytest.mark.parametrize(
    "name",
    ["key", "apikey", "X-Amz-Signature", "tk", "ak", "sk", "pwd", "appid", "app_id", "app_code", "ticket", "login",
     "user", "pass", "sig", "access%5Ftoken", "client_id", "jwt"],
)  # fmt: skip
def test_what_looks_like_a_key_is_hidden(name):
    url = f"https://a.org/wms?map=/x.map&{name}=S3CRET&layers=o"
    assert shown(url) == f"https://a.org/wms?map=/x.map&{name}=...&layers=o"


def test_what_is_no_key_stays():
    url = "https://a.org/wms?map=/x.map&layers=o&styles=&format=image/png&bbox=1,2,3,4&time=2024&z={z}"
    assert shown(url) == url
    assert shown("https://me:word@a.org/x?y=1") == "https://...@a.org/x?y=1"


@pytest.mark.parametrize(
    "source",
    [
        "ftp://me:S3CRET@example.org/{z}/{x}/{y}.png",
        "ftp://example.org/wms?key=S3CRET",
        "https://example.org/{z}/{x}.png?key=S3CRET",
        "https://{s}.example.org/{z}/{x}/{y}.png?tk=S3CRET",
        "https://example.org/{z}/{x}/{y}.png?tk=S3 CRET",
        "http://[::1/{z}/{x}/{y}.png?tk=S3CRET",
    ],
)
def test_refusals_do_not_repeat_keys(tmp_path, source):
    with pytest.raises(OptionError, match="^source: expected") as error:
        fetch_map(settings(source), tmp_path / "map.tif")
    assert "S3" not in str(error.value)
    assert "CRET" not in str(error.value)


def test_nor_do_those_of_heights():
    with pytest.raises(OptionError) as error:
        files_for("https://example.org/{lat}.tif?key=S3CRET", (0.0, 0.0, 1.0, 1.0))
    assert "S3CRET" not in str(error.value)


# ------------------------------------------------------------ addresses that cannot be


@pytest.mark.parametrize(
    "url",
    ["http://[::1/{z}/{x}/{y}.png", "http://h:abc/{z}/{x}/{y}.png", "http://h:99999/{z}/{x}/{y}.png",
     "http://h/a b/{z}/{x}/{y}.png", "http://h/{z}/{x}/{y}.png?a=\n"],
)  # fmt: skip
def test_an_address_that_cannot_be_is_refused_at_once(url):
    with pytest.raises(OptionError, match="^source: expected a URL ") as error:
        check_url("source", url)
    assert "\n" not in str(error.value)


def test_what_the_client_cannot_ask_for_is_asked_for_once(monkeypatch):
    """An address that a server names: of its capabilities, or where it sends to."""
    said = []
    monkeypatch.setattr(client.time, "sleep", lambda _: None)
    for url in ("http://127.0.0.1:9/a b?key=S3CRET", "http://127.0.0.1:abc/"):
        with pytest.raises(MapError, match="cannot be asked for") as error:
            Client(0.0, 1.0, said.append).get(url)
        assert "S3CRET" not in str(error.value)
        assert "\n" not in str(error.value)
    assert said == []
    assert issubclass(client.InvalidURL, HTTPException)  # which else is tried again


@pytest.mark.parametrize("surface", ["http://h/{lat}_{lon}}.tif", "d/{{lat}_{lon}.tif", "d/{lat}{lon}{.tif"])
def test_stray_braces_are_refused(surface):
    with pytest.raises(OptionError, match=r"surface: expected {lat} and {lon} as placeholders, or none"):
        files_for(surface, (0.0, 0.0, 1.0, 1.0))


# ------------------------------------------------------------ where the Earth's grids end


@pytest.mark.parametrize("around", ["0,180", "0,-180", "10,179.9999", "-60,-179.9999"])
def test_a_square_across_the_antimeridian_is_refused(tmp_path, around):
    with pytest.raises(OptionError, match="around: expected a square that does not cross 180 degrees east, got "):
        fetch_map(settings(around=around, dry_run=True), tmp_path / "map.tif")


def test_a_square_beside_it_is_not(tmp_path):
    facts = fetch_map(settings(around="0,179.99", dry_run=True), tmp_path / "map.tif")
    assert facts["tiles"] < 10
    assert Place(0.0, 179.99, 50.0).bounds(CRS.from_epsg(4326))[2] < 180.0


# ------------------------------------------------------------ servers that fall silent


@pytest.fixture
def falls_silent():
    """The address of a server that answers the first request with four bytes, and no other at all."""
    ear, open_lines = socket.create_server(("127.0.0.1", 0)), []
    first = b"HTTP/1.1 206 Partial Content\r\nContent-Length: 4\r\nConnection: close\r\n\r\nII*\0"

    def serve():
        while True:
            try:
                line, _ = ear.accept()
            except OSError:
                return
            line.recv(4096)
            if not open_lines:
                line.sendall(first)
                line.close()
            open_lines.append(line)

    threading.Thread(target=serve, daemon=True).start()
    yield f"http://127.0.0.1:{ear.getsockname()[1]}/heights.tif"
    ear.shutdown(socket.SHUT_RDWR)
    ear.close()
    for line in open_lines:
        line.close()


def test_heights_are_waited_for_no_longer_than_agreed(falls_silent, monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    begin_s = time.monotonic()
    with pytest.raises(MapError, match=re.escape("heights.tif: cannot be read as a GeoTIFF by ranges of bytes")):
        read_part([falls_silent], (0.0, 0.0, 1.0, 1.0), CRS.from_epsg(4326), None, Client(0.0, 1.0, print))
    assert time.monotonic() - begin_s < 20.0  # GDAL asks again, some times
