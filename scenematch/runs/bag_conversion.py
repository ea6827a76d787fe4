"""Converting a flight folder to a bag of ROS 1 or ROS 2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from engine.camera import Camera
from engine.errors import OptionError
from scenematch.files.flight import open_flight
from scenematch.files.ros.bag_writer import BAG_FILES, BAG_KINDS, check_name, check_replaceable, write_bag
from scenematch.files.truth import read_truth
from scenematch.runs.arguments import check_choice
from scenematch.runs.folders import StrPath
from scenematch.runs.inputs import FOLDER_LAYOUT
from scenematch.runs.progress import SILENT, Progress
from scenematch.runs.renaming import renamed_in_errors


def convert_to_bag(
    folder: StrPath, out: StrPath, kind: str | None = None, *, force: bool = False, progress: Progress = SILENT
) -> dict[str, Any]:
    """Write a flight folder's frames, telemetry.csv, camera.yaml and truth.csv (where it has one) as a bag.

    Args:
        folder: the flight folder.
        out: the bag: one file X.bag, X.db3 or X.mcap, or a folder.
        kind: one of :data:`scenematch.files.ros.bag_writer.BAG_KINDS`; None is that of the suffix in
            :data:`scenematch.files.ros.bag_writer.BAG_FILES`, else ros2-mcap.
        force: whether the bag may be there already; it stays until the new one is whole.
        progress: is shown the frames.

    Returns:
        What was written.

    Raises:
        OptionError: the kind is unknown or does not go with the name, or the bag is there.
        TelemetryError, CalibrationError: the folder is no flight, or the bag cannot be written.
    """
    out = Path(out)
    kind = BAG_FILES.get(out.suffix.lower(), "ros2-mcap") if kind is None else kind
    check_choice("kind", kind, BAG_KINDS)
    if not Path(folder).is_dir():
        raise OptionError(f"folder: expected a flight folder, got {folder}; `track` reads a bag as it is")
    with renamed_in_errors(path="out", replace="force"):
        check_name(out, kind)
        check_replaceable(out, force)
    paths = {name: Path(folder) / file for name, file in FOLDER_LAYOUT.items()}
    camera = Camera.load(paths["camera"])
    flight = open_flight(paths["frames"], paths["telemetry"], camera)
    truth = read_truth(paths["truth"]) if paths["truth"].is_file() else []
    frames = ((item.frame, item.prior) for item in progress.track(flight, len(flight), kind))
    count = write_bag(out, frames, camera, kind=kind, truth=truth, replace=force)
    return {"bag": str(out), "format": kind, "frames": count, "truth": len(truth)}
