"""``bag``: a flight folder as a bag of ROS 1 or ROS 2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import check_choice
from engine.errors import OptionError
from engine.formats.bag_writer import KINDS, write_bag
from engine.formats.flight import open_flight
from engine.formats.truth import read_truth

_OWNED = ("metadata.yaml", "*.mcap", "*.db3")


def run_bag(directory: Path, out: Path, kind: str | None, *, force: bool = False) -> dict[str, Any]:
    """Write a flight folder's frames, telemetry.csv, camera.yaml and truth.csv (where it has one) as a bag.

    Args:
        directory: the flight folder.
        out: the bag.
        kind: one of :data:`engine.formats.bag_writer.KINDS`; None is ros1 for a name that ends in .bag, else
            ros2-mcap.
        force: whether the bag may be there already.

    Returns:
        What was written.

    Raises:
        OptionError: the kind is unknown or does not go with the name, or the bag is there.
        TelemetryError, CalibrationError: the folder is no flight, or the bag cannot be written.
    """
    kind = ("ros1" if out.suffix.lower() == ".bag" else "ros2-mcap") if kind is None else kind
    check_choice("--format", kind, KINDS)
    if (out.suffix.lower() == ".bag") != (kind == "ros1"):
        raise OptionError(f"--out: expected a name that ends in .bag for ros1 and for no other format, got {out}")
    camera = Camera.load(directory / "camera.yaml")
    flight = open_flight(directory / "frames", directory / "telemetry.csv", camera)
    truth_path = directory / "truth.csv"
    truth = read_truth(truth_path) if truth_path.is_file() else []
    _make_room(out, force)
    frames = ((item.frame, item.prior) for item in console.progress(flight, len(flight), kind))
    count = write_bag(out, frames, camera, kind=kind, truth=truth)
    return {"bag": str(out), "format": kind, "frames": count, "truth": len(truth)}


def _make_room(out: Path, force: bool) -> None:
    """An older bag leaves; a folder that holds anything else stays, and is an error."""
    if not out.exists():
        return
    if not force:
        raise OptionError(f"--out: {out} exists; choose another name, or add --force to replace it")
    if out.is_file():
        out.unlink()
        return
    files = [file for pattern in _OWNED for file in out.glob(pattern)]
    others = sorted(set(out.iterdir()) - set(files))
    if others:
        raise OptionError(f"--out: expected a bag in {out} to replace, but it holds {others[0].name} too")
    for file in files:
        file.unlink()
    out.rmdir()
