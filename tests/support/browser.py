"""A headless Chromium: what a page does in it, what it asks for, and pictures of it."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.support.waiting import wait_until

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--no-first-run", "--hide-scrollbars",
)  # fmt: skip
WITH_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
_PATIENCE_S = 200.0
_STILL_S = 3.0  # without a change, after which a viewer has drawn all that it has


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

    def open(self, page: Path | str, width_px: int, height_px: int = 900) -> None:
        """Load a file or an address in a window of this size, and wait until it is drawn: until then Chromium
        drops what is typed and clicked.
        """
        size = {"width": width_px, "height": height_px, "deviceScaleFactor": 1, "mobile": False}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        self.requests()  # those of the page before, and of the browser's own first one
        self.driver.get(page if isinstance(page, str) else page.resolve().as_uri())
        self.wait_for("performance.getEntriesByName('first-contentful-paint').length > 0")

    def wait_for(self, condition: str) -> None:
        """Wait until an expression holds in the page, which is looked at with every frame that is drawn.

        Raises:
            selenium.common.exceptions.TimeoutException: it does not come to hold.
        """
        self.driver.set_script_timeout(_PATIENCE_S)
        self.driver.execute_async_script(
            "const done = arguments[0];"
            f"const look = () => ({condition}) ? done() : requestAnimationFrame(look); look();"
        )

    def wait_until_still(self) -> None:
        """Wait until what is shown has colours and does not change any more.

        Raises:
            TimeoutError: it is blank, or changes on and on.
        """
        from selenium.common.exceptions import TimeoutException

        before, since = b"", time.monotonic()
        end = since + _PATIENCE_S
        while time.monotonic() < end:
            try:
                now = self.driver.get_screenshot_as_png()
            except TimeoutException:  # it is busy drawing
                continue
            if now != before:
                before, since = now, time.monotonic()
            elif time.monotonic() - since > _STILL_S and len(now) > 50_000:  # a blank one has a few kilobytes
                return
            time.sleep(0.5)
        raise TimeoutError("the page did not come to rest")

    def run(self, script: str) -> Any:
        """What a script returns."""
        return self.driver.execute_script(script)

    def press(self, key: str) -> None:
        """A key of the keyboard, by its name in the DOM."""
        for kind in ("keyDown", "keyUp"):
            codes = {"ArrowLeft": 37, "ArrowRight": 39, "End": 35}
            event = {"type": kind, "key": key, "code": key, "windowsVirtualKeyCode": codes[key]}
            self.driver.execute_cdp_cmd("Input.dispatchKeyEvent", event)

    def complaints(self) -> list[str]:
        """Errors and warnings on the console."""
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def requests(self) -> list[str]:
        """The addresses that were asked for, those inside the page and the browser's own left out."""
        events = (json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance"))
        sent = (e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent")
        return [url for url in sent if not url.startswith(("data:", "chrome:"))]

    def save(self, path: Path) -> None:
        """A picture of the window."""
        self.driver.save_screenshot(str(path))


@contextmanager
def open_browser(gl: tuple[str, ...] = ("--disable-gpu",)) -> Iterator[Browser]:
    """A browser with a profile of its own, closed at the end; with ``WITH_GL`` it draws in 3D."""
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        for flag in (*FLAGS, *gl, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        try:
            yield Browser(driver)
        finally:
            driver.quit()


@contextmanager
def serve_recording(recording: Path) -> Iterator[str]:
    """The address of rerun's viewer in the browser, on loopback, with a recording in it."""
    data_port, page_port = _free_port(), _free_port()
    command = [sys.executable, "-m", "rerun_cli", "--serve-web", "--bind", "127.0.0.1"]
    command += ["--port", str(data_port), "--web-viewer-port", str(page_port), str(recording)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen(command, start_new_session=True, **quiet)  # Python starts the server proper
    try:
        wait_until(lambda: _listens(page_port) and _listens(data_port), _PATIENCE_S)
        source = f"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A{data_port}%2Fproxy"
        yield f"http://127.0.0.1:{page_port}/?url={source}&renderer=webgl&hide_welcome_screen=1"
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()


def _free_port() -> int:
    with socket.socket() as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


def _listens(port: int) -> bool:
    with socket.socket() as made:
        return made.connect_ex(("127.0.0.1", port)) == 0
