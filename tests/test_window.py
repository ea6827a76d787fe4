"""The adaptive window: equations 4 and 5 in the paper's own figures, the edge of the map, growth in flight."""

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from engine import Fix, Frame, NoFix, OptionError, Prior, SceneMatcher
from engine.window import place_window, window_size_px

SIDE_PX = 300.0
SCALE = 1.0894  # eq. 2: 150 m / (259.8 px * 0.53 m/px)
FOOTPRINT = (SCALE * SIDE_PX, SCALE * SIDE_PX)


def test_equations_4_and_5_in_the_papers_figures():
    """7 m/s to the east over 0.53 m/px is 13.2075 px/s; the NCC method takes 40 ms, SIFT 121 ms."""
    moved = window_size_px(FOOTPRINT, (13.2075 * 0.040, 0.0))
    assert moved == pytest.approx((424.866 + 0.5283, 424.866), abs=1e-3)  # 1.3 * 1.0894 * 300 = 424.866
    moved = window_size_px(FOOTPRINT, (0.0, -13.2075 * 0.121))
    assert moved == pytest.approx((424.866, 424.866 + 1.5981), abs=1e-3)


@pytest.mark.parametrize("extent", [(0.0, 5.0), (5.0, -1.0), (float("inf"), 5.0), (5.0, float("nan"))])
def test_an_extent_that_is_none_is_refused(extent):
    with pytest.raises(OptionError, match=r"^footprint_px: expected positive finite extents, got "):
        window_size_px(extent, (0.0, 0.0))


@given(
    center=st.tuples(st.floats(-80.0, 180.0), st.floats(-80.0, 180.0)),
    size=st.tuples(st.floats(0.5, 150.0), st.floats(0.5, 150.0)),
    limit=st.tuples(st.integers(1, 100), st.integers(1, 100)),
)
@example(center=(105.2, 50.0), size=(10.0, 10.0), limit=(100, 100))  # it ends where the map does
def test_a_window_is_what_the_crop_and_the_map_have_in_common(center, size, limit):
    window = place_window(center, size, limit)
    common = []
    for middle, extent, count in zip(center, size, limit, strict=True):
        low, high = middle - extent / 2, middle + extent / 2
        assume(min(abs(low - 0.5 - round(low - 0.5)), abs(high - 0.5 - round(high - 0.5))) > 1e-9)
        common.append([k for k in range(count) if low < k + 0.5 and high > k - 0.5])
    if not all(common):
        assert window is None
        return
    assert (window.x0, window.y0) == (common[0][0], common[1][0])
    assert (window.width_px, window.height_px) == (len(common[0]), len(common[1]))
    assert window.area_px == len(common[0]) * len(common[1])


@pytest.fixture(scope="module")
def matcher(ground, camera):
    return SceneMatcher(ground.site, camera, "ncc", "cpu")


def test_the_window_grows_with_the_sigma_of_the_prior(matcher, ground, camera):
    nadir = np.array([330.0, 290.0])
    frame = ground.frame(camera, nadir)
    fixes = [matcher.locate(frame, ground.prior(nadir, sigma_m=sigma_m)) for sigma_m in (8.0, 20.0, 28.0)]
    widths = [fix.window.width_px for fix in fixes]
    assert widths[0] < widths[1] < widths[2]


def test_the_window_of_a_fix_is_equations_4_and_5(matcher, ground, camera):
    """173.2 m of footprint at 0.5 m/px, 1.3 times, and 14 m moved to the east."""
    nadir = np.array([320.0, 300.0])
    east, north = ground.enu_from_pixel(nadir)
    frame = ground.frame(camera, nadir)
    grid_scale = ground.gsd_m / ground.site.gsd_m_per_px  # UTM shrinks by 0.9996 on its central meridian
    footprint = 2 * 150 * np.tan(np.pi / 6) / ground.gsd_m * grid_scale
    still = matcher.locate(frame, Prior(east_m=east, north_m=north, sigma_m=1.0))
    moved = matcher.locate(frame, Prior(east_m=east, north_m=north, sigma_m=1.0, moved_east_m=-14.0))
    assert (still.window.width_px, still.window.height_px) == pytest.approx((1.3 * footprint,) * 2, abs=1.0)
    assert moved.window.width_px - still.window.width_px == pytest.approx(14.0 / 0.5, abs=1.0)
    assert moved.window.height_px == still.window.height_px


def test_every_frame_that_was_searched_records_its_window(ground, camera):
    blind = np.random.default_rng(1).integers(0, 256, (300, 300), dtype=np.uint8)
    nadir = np.array([320.0, 300.0])
    for method in ("ncc", "sift"):
        matcher = SceneMatcher(ground.site, camera, method, "cpu")
        for image, kind in ((ground.picture(camera, nadir, 150.0), Fix), (blind, NoFix)):
            for prior in (ground.prior(nadir), None):
                result = matcher.locate(Frame(image, 0, 150.0, 0.0, 0.0, 0.0), prior)
                assert isinstance(result, kind), (method, result)
                window = result.window
                assert 0 <= window.x0 < window.x0 + window.width_px <= 640
                assert 0 <= window.y0 < window.y0 + window.height_px <= 600
                if prior is not None:
                    assert window.area_px < 640 * 600
