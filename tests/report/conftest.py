"""The browser of the tests of pages."""

import pytest

from tests.support.browser import missing, open_browser


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium."""
    if missing():
        pytest.skip(missing())
    with open_browser() as opened:
        yield opened
