"""The same work written with other people's libraries, as their users would write it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from engine import Camera, Frame, OrthoMap, Prior
from engine.geo import enu_from_body

Image = NDArray[np.float32]


def opencv_peak(window: Image, template: Image) -> tuple[int, int, float]:
    """The place (x, y) and score of the highest peak by OpenCV."""
    scores = cv2.matchTemplate(window, template, cv2.TM_CCOEFF_NORMED)
    _, score, _, (x, y) = cv2.minMaxLoc(scores)
    return x, y, score


def skimage_peak(window: Image, template: Image) -> tuple[int, int, float]:
    """The same by scikit-image."""
    from skimage.feature import match_template

    scores = match_template(window, template)
    y, x = np.unravel_index(int(scores.argmax()), scores.shape)
    return int(x), int(y), float(scores[y, x])


def scipy_peak(window: Image, template: Image) -> tuple[int, int, float]:
    """The same by SciPy's fftconvolve, the recipe that answers on the web give."""
    from scipy.signal import fftconvolve

    w, t = window.astype(np.float64), template.astype(np.float64)
    t = t - t.mean()
    ones = np.ones(t.shape)
    products = fftconvolve(w, t[::-1, ::-1], mode="valid")
    total = fftconvolve(w, ones, mode="valid")
    square = fftconvolve(w * w, ones, mode="valid")
    energy = np.maximum(square - total * total / t.size, 1e-9)
    scores = products / np.sqrt(energy * np.sum(t * t))
    y, x = np.unravel_index(int(scores.argmax()), scores.shape)
    return int(x), int(y), float(scores[y, x])


class OpenCvStep:
    """The NCC step on one frame with OpenCV: what a good user of it would write.

    Grey, rectify by height, heading, roll and pitch with one ``warpPerspective``, local normalisation of frame and
    window, ``matchTemplate``, and a parabola through the peak. With ``prepared`` the normalised map is kept.
    """

    def __init__(self, site: OrthoMap, camera: Camera, *, prepared: bool, radius_px: int = 8) -> None:
        from engine.types import Window

        self._site, self._camera, self._radius_px = site, camera, radius_px
        self._gray = site.gray(Window(0, 0, site.width_px, site.height_px))
        self._map = self._enhance(self._gray) if prepared else None
        self._jacobian = site.enu_jacobian(np.array([site.width_px, site.height_px]) / 2.0)

    def _enhance(self, gray: NDArray[np.uint8]) -> Image:
        box = (2 * self._radius_px + 1,) * 2
        smooth = cv2.GaussianBlur(gray, (3, 3), 0)
        mean = cv2.boxFilter(smooth, cv2.CV_32F, box)
        square = cv2.sqrBoxFilter(smooth, cv2.CV_32F, box)
        return np.asarray((smooth - mean) / np.sqrt(np.maximum(square - mean * mean, 0.0) + 4.0), np.float32)

    def __call__(self, frame: Frame, prior: Prior) -> tuple[float, float]:
        """East and north in metres."""
        camera, jacobian = self._camera, self._jacobian
        assert isinstance(frame.image, np.ndarray)
        assert frame.height_agl_m is not None
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        body = enu_from_body(frame.roll_deg or 0.0, frame.pitch_deg or 0.0, frame.heading_deg or 0.0)
        turn = body @ camera.mount
        ray = turn @ np.linalg.inv(camera.matrix) @ np.array([149.5, 149.5, 1.0])
        aim = np.linalg.solve(jacobian, ray[:2] * frame.height_agl_m / -ray[2])
        scale = frame.height_agl_m / (camera.focal_px * self._site.gsd_m_per_px)
        side = int(0.7 * scale * camera.width_px)
        offset = np.round(aim - (side - 1) / 2)
        plane = np.zeros((3, 3))
        plane[:2, :2], plane[2, 2] = jacobian, -frame.height_agl_m
        shift = np.array([[1, 0, offset[0]], [0, 1, offset[1]], [0, 0, 1.0]])
        homography = camera.matrix @ turn.T @ plane @ shift
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        template = self._enhance(cv2.warpPerspective(gray, homography, (side, side), flags=flags))
        nadir = self._site.pixel_from_enu(np.array([prior.east_m, prior.north_m]))
        half = (1.3 * scale * camera.width_px + 7.0 * 0.2 / self._site.gsd_m_per_px) / 2
        x0, y0 = (max(0, int(v - half)) for v in nadir + aim)
        x1, y1 = (int(v + half) for v in nadir + aim)
        cut = np.s_[y0:y1, x0:x1]
        window = self._enhance(self._gray[cut]) if self._map is None else self._map[cut]
        scores = cv2.matchTemplate(np.ascontiguousarray(window), template, cv2.TM_CCOEFF_NORMED)
        _, _, _, (x, y) = cv2.minMaxLoc(scores)
        place = np.array([x0 + x, y0 + y], dtype=float)
        if 0 < x < scores.shape[1] - 1 and 0 < y < scores.shape[0] - 1:
            place += [_parabola(scores[y, x - 1 : x + 2]), _parabola(scores[y - 1 : y + 2, x])]
        east, north = self._site.enu_from_pixel(place - offset)
        return float(east), float(north)


def _parabola(three: Image) -> float:
    low, middle, high = (float(v) for v in three)
    return 0.5 * (low - high) / (low - 2.0 * middle + high)
