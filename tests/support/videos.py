"""Small videos for tests."""

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
