"""From frame to map: every sign and every half pixel, each against rays written out by hand.

The frames of :class:`Ground` are drawn ray by ray, so that no homography of the engine checks itself.
"""

import itertools
import math
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine import Attitude, Camera, Frame, MatcherOptions, NccOptions, SceneMatcher, SiftOptions
from engine.matching.align import FRACTION, MAX_RAY_DEG, rectify, view_of
from engine.matching.oblique import largest_rectangle
from tests.support.fixes import px_off
from tests.support.ground import rays_of

CAMERA = Camera.from_fov(300, 300, 60.0)
UPRIGHT = np.array([[0.5, 0.0], [0.0, -0.5]])  # metres east and north per map pixel
NADIR = np.array([310.0, 305.0])
METHODS = ("ncc", "sift")
PIXELS = 0.3  # the most that a fix may be off, in map pixels


@lru_cache(maxsize=4)
def matcher_of(site, camera, method):
    """The one that the tests before have used: what it has prepared of the map is as it was.

    Nothing is refined, which would put right what the alignment does wrong.
    """
    options = MatcherOptions(ncc=NccOptions(refine=False), sift=SiftOptions(refine=False))
    return SceneMatcher(site, camera, method, "cpu", options)


def locate(ground, camera, frame, method="ncc"):
    return matcher_of(ground.site, camera, method).locate(frame, ground.prior(NADIR))


# Equations 2 and 3: scale and heading


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "taken",
    [
        *({"heading_deg": heading_deg} for heading_deg in (30.0, 90.0, 137.0, 271.5, 359.9)),
        *({"height_m": height_m, "heading_deg": 12.0} for height_m in (90.0, 220.0)),
        *({angle: 8.0, "heading_deg": 90.0} for angle in ("roll_deg", "pitch_deg")),
        *({angle: -15.0, "heading_deg": 200.0} for angle in ("roll_deg", "pitch_deg")),
        {"roll_deg": -11.0, "pitch_deg": 9.0, "heading_deg": 233.0},  # in aerospace order
    ],
    ids=str,
)
def test_a_frame_of_any_heading_height_and_tilt_is_found_where_it_was_taken(ground, camera, taken, method):
    """Headings are clockwise from north, a positive roll lowers the right side, positive pitch lifts the nose."""
    assert px_off(locate(ground, camera, ground.frame(camera, NADIR, **taken), method), NADIR) < PIXELS


@pytest.mark.parametrize("size", [(320, 240), (301, 200)])
def test_scale_of_frames_much_finer_than_the_map_keeps_their_place(ground, size):
    """Every map pixel is the average of a dozen frame pixels, and none of the two rasters' half pixels is lost."""
    camera = Camera.from_fov(4 * size[0], 4 * size[1], 60.0)
    assert px_off(locate(ground, camera, ground.frame(camera, NADIR, 140.0, heading_deg=77.0)), NADIR) < 0.15


# Tilt


@pytest.mark.parametrize("method", METHODS)
def test_a_camera_that_is_mounted_the_other_way_round_finds_the_same_place(ground, camera, method):
    backwards = Camera(300, 300, camera.matrix, mount=camera.mount @ np.diag([-1.0, -1.0, 1.0]))
    frame = ground.frame(camera, NADIR, roll_deg=4.0, pitch_deg=-6.0, heading_deg=51.0)
    turned = Frame(np.ascontiguousarray(frame.image[::-1, ::-1]), 0, 150.0, 51.0, 4.0, -6.0)
    assert px_off(locate(ground, backwards, turned, method), NADIR) < PIXELS


@pytest.mark.parametrize("method", METHODS)
def test_an_off_centre_principal_point_is_honoured(ground, method):
    camera = Camera(320, 240, np.array([[250.0, 0.0, 170.0], [0.0, 255.0, 110.0], [0.0, 0.0, 1.0]]))
    frame = ground.frame(camera, NADIR, heading_deg=160.0, pitch_deg=3.0)
    assert px_off(locate(ground, camera, frame, method), NADIR) < PIXELS


@given(
    roll=st.floats(-25.0, 25.0),
    pitch=st.floats(-25.0, 25.0),
    heading=st.floats(0.0, 360.0),
    height=st.floats(2.0, 2000.0),
    convergence=st.floats(-3.0, 3.0),
)
def test_the_view_is_what_rays_do(roll, pitch, heading, height, convergence):
    c, s = math.cos(math.radians(convergence)), math.sin(math.radians(convergence))
    jacobian = np.array([[c, s], [-s, c]]) @ UPRIGHT
    view = view_of(CAMERA, Attitude(roll, pitch, heading), height, jacobian)

    def hits_of(pixels):
        rays = rays_of(CAMERA, pixels, roll_deg=roll, pitch_deg=pitch, heading_deg=heading)
        hits_m = rays[:, :2] * (height / -rays[:, 2])[:, None]
        return np.linalg.solve(jacobian, hits_m.T).T

    pixels = np.array([[0.0, 0.0], [299.0, 0.0], [40.0, 250.0], [149.5, 149.5]])
    hits_px = hits_of(pixels)
    seen = np.c_[hits_px, np.ones(4)] @ view.image_from_map.T
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], pixels, atol=1e-6)
    np.testing.assert_allclose(view.center_px, hits_px[3], atol=1e-6 * height)
    corners = hits_of([[-0.5, -0.5], [299.5, -0.5], [299.5, 299.5], [-0.5, 299.5]])
    np.testing.assert_allclose(view.footprint_px, np.ptp(corners, axis=0), rtol=1e-9)
    x, y = corners.T
    shoelace = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
    assert view.area_px == pytest.approx(shoelace, rel=1e-4)


@pytest.mark.parametrize("angle", [-1.0, 1.0])
@pytest.mark.parametrize("axis", ["roll", "pitch"])
def test_there_is_no_view_where_a_corner_looks_at_the_horizon(axis, angle):
    # Each half of the frame spans 30 degrees; its corners lie a little further out.
    steepest = MAX_RAY_DEG - 30.0
    for tilt, sees in ((steepest - 5.0, True), (steepest, False), (90.0, False), (180.0, False)):
        roll, pitch = (angle * tilt, 0.0) if axis == "roll" else (0.0, angle * tilt)
        assert (view_of(CAMERA, Attitude(roll, pitch, 30.0), 150.0, UPRIGHT) is not None) == sees, tilt


@given(roll=st.floats(-25.0, 25.0), pitch=st.floats(-25.0, 25.0), heading=st.floats(0.0, 360.0))
def test_a_patch_holds_frame_alone(roll, pitch, heading):
    """No corner of the patch lies outside the frame, and it keeps to whole map pixels and to its size."""
    view = view_of(CAMERA, Attitude(roll, pitch, heading), 150.0, UPRIGHT)
    patch = rectify(np.full((300, 300), 9, np.uint8), view)
    height, width = patch.gray.shape
    corners = patch.offset_px + np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]])
    seen = np.c_[corners, np.ones(4)] @ view.image_from_map.T
    pixels = seen[:, :2] / seen[:, 2:]
    assert pixels.min() > -1.5
    assert pixels.max() < 300.5
    assert (patch.offset_px == np.round(patch.offset_px)).all()
    assert width * height <= FRACTION**2 * view.area_px * 1.001
    assert (patch.gray == 9).all()


def test_a_frame_that_covers_a_few_map_pixels_gives_no_patch():
    view = view_of(CAMERA, Attitude(0.0, 0.0, 0.0), 4.0, UPRIGHT)  # 9 map pixels wide
    assert rectify(np.zeros((300, 300), np.uint8), view) is None


# The largest upright part of an oblique frame that shows the map


@pytest.mark.parametrize("seed", range(6))
def test_the_largest_rectangle_is_that_of_an_exhaustive_search(seed):
    valid = np.random.default_rng(seed).random((9, 11)) > 0.25
    best = 0
    for top, bottom in itertools.combinations(range(10), 2):
        for left, right in itertools.combinations(range(12), 2):
            if valid[top:bottom, left:right].all():
                best = max(best, (bottom - top) * (right - left))
    box = largest_rectangle(valid)
    assert box.area_px == best
    assert valid[box.y0 : box.y0 + box.height_px, box.x0 : box.x0 + box.width_px].all()


def test_a_large_one_is_found_within_a_cell():
    valid = np.zeros((480, 640), bool)
    valid[101:402, 53:517] = True
    box = largest_rectangle(valid)
    assert valid[box.y0 : box.y0 + box.height_px, box.x0 : box.x0 + box.width_px].all()
    assert box.area_px > 0.95 * 301 * 464
    assert largest_rectangle(np.zeros((50, 50), bool)).area_px == 0
    assert largest_rectangle(np.ones((1, 200), bool)).area_px == 0  # lower than a cell
