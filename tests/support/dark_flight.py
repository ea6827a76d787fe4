"""A flight with a frame that shows nothing, and what the page of its report is given."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

FRAMES, DARK = 6, 4


def dark_flight(flight_in: Any, folder: Path) -> Any:
    """Write the flight to a folder; its files."""
    files = flight_in(folder, frames=FRAMES)
    cv2.imwrite(str(folder / "frames" / f"{DARK:06d}.jpg"), np.zeros((300, 300, 3), np.uint8))
    return files


def data_of(page: Path) -> Any:
    """What the page's script is given."""
    text = page.read_text(encoding="utf-8").partition('id="data">')[2]
    return json.loads(text.partition("</script>")[0])
