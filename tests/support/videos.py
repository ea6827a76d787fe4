"""Small videos for tests, and subtitles as DJI's drones write them beside one."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np


def write_video(path, grays, *, size=(64, 48), rate_hz=25.0, codec="MJPG"):
    """Write a video of pictures of one grey level each.

    Args:
        path: the file.
        grays: level of each picture.
        size: width and height.
        rate_hz: pictures per second.
        codec: four letters.
    """
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate_hz, size)
    for gray in grays:
        writer.write(np.full((size[1], size[0], 3), gray, np.uint8))
    writer.release()


def write_subtitles(path: Path, texts: Iterable[str], step_ms: int = 40) -> Path:
    """Write a cue for each text, so many milliseconds apart; the path."""
    cues = []
    for k, text in enumerate(texts):
        seconds, ms = divmod(step_ms * k, 1000)
        moment = f"00:00:{seconds:02d},{ms:03d}"
        cues.append(f"{k + 1}\n{moment} --> {moment}\n{text}\n\n")
    path.write_text("".join(cues), encoding="utf-8")
    return path
