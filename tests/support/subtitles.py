"""Subtitles as DJI's drones write them beside a video."""

from collections.abc import Iterable
from pathlib import Path


def write_subtitles(path: Path, texts: Iterable[str], step_ms: int = 40) -> Path:
    """Write a cue for each text, so many milliseconds apart; the path."""
    cues = []
    for k, text in enumerate(texts):
        seconds, ms = divmod(step_ms * k, 1000)
        moment = f"00:00:{seconds:02d},{ms:03d}"
        cues.append(f"{k + 1}\n{moment} --> {moment}\n{text}\n\n")
    path.write_text("".join(cues), encoding="utf-8")
    return path
