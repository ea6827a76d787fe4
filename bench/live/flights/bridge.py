"""The bridge of a simulated flight, a process of its own, and what faults do to it and its camera."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from bench.live.flights.faults import Fault
from bench.live.flights.recorded import recorded


class Bridge:
    """The bridge's process, its worker and its camera, killed and started together.

    Args:
        folder: of the flight.
        port: to listen on.
        method, message: of the fixes.
        camera: the source of its pictures.
        more: further options of the bridge.
    """

    def __init__(
        self,
        folder: Path,
        port: int,
        method: str,
        message: str,
        camera: str,
        more: Sequence[str],
    ) -> None:
        start, self.fault_file = recorded(folder)[1], folder / "fault"
        self.fault_file.unlink(missing_ok=True)
        self._command = [
            sys.executable, "-m", "scenematch", "bridge", "mavlink", "--supervise", "--method", method,
            "--connect", f"udpin:127.0.0.1:{port}", "--map", str(folder / "map.tif"),
            "--surface", str(folder / "dsm.tif"), "--camera", str(folder / "camera.yaml"),
            "--camera-source", camera, "--start", f"{start.lat_deg},{start.lon_deg},15",
            "--settings", f"mavlink.message={message}", *more,
        ]  # fmt: skip
        # An installation brings its bytecode along.
        self._environment = {name: v for name, v in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        self._log = (folder / "bridge.log").open("w", encoding="utf-8")
        self.start()

    def start(self) -> None:
        """Start it in its own process group."""
        self._process = subprocess.Popen(
            self._command, stdout=self._log, stderr=self._log, env=self._environment, start_new_session=True
        )

    def kill(self) -> None:
        """All of it."""
        with contextlib.suppress(ProcessLookupError):  # it has already ended
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def kill_worker(self) -> None:
        """Kill only the worker that matches."""
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children")
        os.kill(int(children.read_text(encoding="ascii").split()[-1]), signal.SIGKILL)


def change(fault: Fault, bridge: Bridge, *, is_over: bool) -> None:
    """Begin or end a fault; what passes at once has no end."""
    if is_over and not fault.seconds:
        return
    if fault.kind == "bridge killed":
        bridge.start() if is_over else bridge.kill()
    elif fault.kind == "worker killed":
        bridge.kill_worker()
    else:
        bridge.fault_file.write_text("" if is_over else fault.kind, encoding="ascii")
