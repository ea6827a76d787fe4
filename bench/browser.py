"""A headless Chromium: what a page does in it, and pictures of pages for the documentation.

``python -m bench.browser PAGE.html docs/img/report.png [--height 1500] [--script JS] [--element CSS]``
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--hide-scrollbars",
)


def missing() -> str:
    """What a browser test lacks here, or nothing."""
    found = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    try:
        import selenium  # noqa: F401
    except ImportError:
        found.append("selenium")
    return "" if not found else f"not installed: {', '.join(found)} (apt: chromium, chromium-driver)"


class Browser:
    """One page at a time; what it asks the network for and tells the console is noted."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, page: Path, width_px: int, height_px: int = 900) -> None:
        """Load a file in a window of this size."""
        self.resize(width_px, height_px)
        self.requests()  # those of the page before, and of the browser's own first one
        self.driver.get(page.resolve().as_uri())

    def resize(self, width_px: int, height_px: int) -> None:
        """Change the window."""
        size = {"width": width_px, "height": height_px, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)

    def run(self, script: str) -> Any:
        """What a script returns."""
        return self.driver.execute_script(script)

    def press(self, key: str) -> None:
        """A key of the keyboard, by its name in the DOM."""
        for kind in ("keyDown", "keyUp"):
            codes = {"ArrowLeft": 37, "ArrowRight": 39, "Tab": 9, "Home": 36, "End": 35}
            event = {"type": kind, "key": key, "code": key, "windowsVirtualKeyCode": codes[key]}
            self.driver.execute_cdp_cmd("Input.dispatchKeyEvent", event)

    def complaints(self) -> list[str]:
        """What the console was told of errors and warnings."""
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def requests(self) -> list[str]:
        """The addresses that were asked for, those inside the page (data:) left out."""
        events = (json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance"))
        sent = (e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent")
        return [url for url in sent if not url.startswith("data:")]

    def save(self, path: Path, element: str | None = None) -> None:
        """A picture of the window, or of one element."""
        if element is None:
            self.driver.save_screenshot(str(path))
        else:
            self.driver.find_element("css selector", element).screenshot(str(path))


@contextmanager
def open_browser() -> Iterator[Browser]:
    """A browser with a profile of its own, closed at the end."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        try:
            yield Browser(driver)
        finally:
            driver.quit()


def main() -> None:
    """Take a picture of a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=1500)
    parser.add_argument("--script", default="", help="run before the picture is taken")
    parser.add_argument("--element", help="CSS selector of what is taken; all of the window unless given")
    arguments = parser.parse_args()
    with open_browser() as browser:
        browser.open(arguments.page, arguments.width, arguments.height)
        browser.run(arguments.script)
        browser.save(arguments.picture, arguments.element)


if __name__ == "__main__":
    main()
