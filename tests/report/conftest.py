"""What the tests of pages share: a browser, and a finished run."""

import pytest

from scenematch import TrackSettings, track
from tests.support.browser import missing, open_browser
from tests.support.dark_flight import dark_flight
from tests.support.runs import bare_runs


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium."""
    if missing():
        pytest.skip(missing())
    with open_browser() as opened:
        yield opened


@pytest.fixture(scope="package")
def flown(flight_in, tmp_path_factory):
    """The folder of a finished run over a flight with a dark frame, both in one whose name is markup."""
    folder = tmp_path_factory.mktemp("<img src=x onerror=hacked=1>")
    with bare_runs():
        files = dark_flight(flight_in, folder / "flight")
        track(files, folder / "out", TrackSettings(device="cpu", budget_ms=3_600_000.0))
    return folder / "out"
