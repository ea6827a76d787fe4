"""``bag``: a flight folder as a bag of ROS 1 or ROS 2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from engine.camera import Camera
from engine.cli import console
from engine.cli.arguments import check_choice
from engine.errors import OptionError
from engine.formats.flight import open_flight
from engine.formats.ros.bag_writer import BAG_KINDS, check_replaceable, write_bag
from engine.formats.truth import read_truth


def run_bag(directory: Path, out: Path, kind: str | None, *, force: bool = False) -> dict[str, Any]:
    """Write a flight folder's frames, telemetry.csv, camera.yaml and truth.csv (where it has one) as a bag.

    Args:
        directory: the flight folder.
        out: the bag.
        kind: one of :data:`engine.formats.ros.bag_writer.BAG_KINDS`; None is ros1 for a name in .bag, else
            ros2-mcap.
        force: whether the bag may be there already; it stays until the new one is whole.

    Returns:
        What was written.

    Raises:
        OptionError: the kind is unknown or does not go with the name, or the bag is there.
        TelemetryError, CalibrationError: the folder is no flight, or the bag cannot be written.
    """
    kind = ("ros1" if out.suffix.lower() == ".bag" else "ros2-mcap") if kind is None else kind
    check_choice("--format", kind, BAG_KINDS)
    if (out.suffix.lower() == ".bag") != (kind == "ros1"):
        raise OptionError(f"--out: expected a name that ends in .bag for ros1 and for no other format, got {out}")
    check_replaceable(out, force)
    camera = Camera.load(directory / "camera.yaml")
    flight = open_flight(directory / "frames", directory / "telemetry.csv", camera)
    truth_path = directory / "truth.csv"
    truth = read_truth(truth_path) if truth_path.is_file() else []
    frames = ((item.frame, item.prior) for item in console.progress(flight, len(flight), kind))
    count = write_bag(out, frames, camera, kind=kind, truth=truth, replace=force)
    return {"bag": str(out), "format": kind, "frames": count, "truth": len(truth)}
