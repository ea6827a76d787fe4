"""The map: where its pixels lie, what is nodata, and what is refused."""

import json

import numpy as np
import pytest
import rasterio
from affine import Affine
from hypothesis import example, given
from hypothesis import strategies as st
from pyproj import Geod, Proj, Transformer
from rasterio.enums import ColorInterp, Resampling
from rasterio.warp import calculate_default_transform, reproject

from engine import DtypeError, MapError, OptionError, OrthoMap, ShapeError, Window
from engine.maps.accuracy import GEOREFERENCE_TAG, SLOPE_TAG
from scenematch.files.geotiff import write_geotiff
from tests.support.rasters import whole, write_raster
from tests.support.refusals import misuse, refusal

UTM = "EPSG:32636"
STEP_M = 0.5
WEST, NORTH = 686000.0, 3630000.0
CORNER = Affine(STEP_M, 0.0, WEST, 0.0, -STEP_M, NORTH)
DEGREES = {"crs": "EPSG:4326", "transform": Affine(1e-5, 0, 33, 0, -8e-6, 32)}
CENTRED = np.array([[STEP_M, 0.0, WEST + STEP_M / 2], [0.0, -STEP_M, NORTH - STEP_M / 2]])


def noise(*shape, low=1, high=255, seed=0):
    """Grey without pure black or white, so that no collar is found in it."""
    return np.random.default_rng(seed).integers(low, high, shape).astype(np.uint8)


def write(path, data, **profile):
    return write_raster(path, data, **({"crs": UTM, "transform": CORNER} | profile))


@pytest.fixture(scope="module")
def site():
    y, x = np.mgrid[0:90, 0:120]
    return OrthoMap.from_arrays(noise(90, 120), CENTRED, UTM, surface_m=(0.25 * x + 0.5 * y).astype(np.float32))


# --- where pixels lie ---------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
@pytest.mark.parametrize("kind", ["Area", "Point"])
def test_corner_origin_becomes_the_centre_once(tmp_path, kind):
    path = write(tmp_path / "map.tif", noise(40, 60), tags={"AREA_OR_POINT": kind})
    site = OrthoMap.open(path, crs=UTM)  # its own may be named again
    with rasterio.open(path) as dataset:
        east, north = dataset.xy(7, 11)  # row, column; the centre of the pixel
    assert (east, north) == (WEST + 11.5 * STEP_M, NORTH - 7.5 * STEP_M)
    lon, lat = Transformer.from_crs(UTM, 4326, always_xy=True).transform(east, north)
    assert np.allclose(site.geodetic_from_pixel([11, 7]), (lat, lon), rtol=0, atol=1e-11)
    assert np.allclose(site.pixel_from_geodetic(lat, lon), [11, 7], rtol=0, atol=1e-6)


def test_frame_is_at_the_centre_and_bounds_are_outer_edges(site):
    centre = np.array([59.5, 44.5])
    assert np.allclose(site.enu_from_pixel(centre), 0.0, atol=1e-6)
    assert np.allclose(site.geodetic_from_pixel(centre), (site.frame.lat_deg, site.frame.lon_deg))
    lat, lon = site.geodetic_from_pixel([[-0.5, -0.5], [119.5, 89.5], [-0.5, 89.5], [119.5, -0.5]])
    assert np.allclose(site.bounds_deg, (lon.min(), lat.min(), lon.max(), lat.max()))


@given(x=st.floats(-60, 180) | st.floats(-4e4, 4e4), y=st.floats(-60, 150) | st.floats(-4e4, 4e4))
@example(x=40_000.0, y=-30_000.0)  # so far outside the map that the exact functions answer
def test_round_trips_stay_below_a_millimetre(site, x, y):
    xy = np.array([x, y])
    assert np.allclose(site.pixel_from_enu(site.enu_from_pixel(xy)), xy, rtol=0, atol=1e-5)
    lat, lon = site.geodetic_from_pixel(xy)
    assert np.allclose(site.pixel_from_geodetic(lat, lon), xy, rtol=0, atol=1e-5)
    assert np.allclose(site.enu_from_pixel(xy), site.frame.enu_from_geodetic(lat, lon), rtol=0, atol=1e-3)


def test_points_keep_their_leading_axes(site):
    xy = np.random.default_rng(1).uniform(0, 80, (2, 3, 2))
    assert site.enu_from_pixel(xy).shape == site.pixel_from_enu(xy).shape == (2, 3, 2)
    assert site.surface_at(xy).shape == (2, 3)
    assert np.allclose(site.enu_from_pixel(xy)[1, 2], site.enu_from_pixel(xy[1, 2]), atol=1e-9)
    assert site.enu_from_pixel(np.zeros((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    ("crs", "x", "y"), [(UTM, WEST, NORTH), ("EPSG:3857", 3.9e6, 6.0e6), ("EPSG:2263", 9.8e5, 2e5)]
)
def test_jacobian_and_gsd_are_metres_on_the_ground(crs, x, y):
    site = OrthoMap.from_arrays(noise(50, 70), [[0.5, 0, x], [0, -0.5, y]], crs)
    centre = np.array([34.5, 24.5])
    lat, lon = site.geodetic_from_pixel(centre + np.array([[-0.5, 0], [0.5, 0], [0, -0.5], [0, 0.5]]))
    _, _, step_x_m = Geod(ellps="WGS84").inv(lon[0], lat[0], lon[1], lat[1])
    _, _, step_y_m = Geod(ellps="WGS84").inv(lon[2], lat[2], lon[3], lat[3])
    assert site.gsd_m_per_px == pytest.approx(np.sqrt(step_x_m * step_y_m), rel=1e-5)
    jacobian = site.enu_jacobian(centre)
    assert np.allclose(np.linalg.norm(jacobian, axis=0), [step_x_m, step_y_m], rtol=1e-5)
    difference = site.enu_from_pixel([37.5, 22.5]) - site.enu_from_pixel(centre)
    assert np.allclose(jacobian @ [3.0, -2.0], difference, atol=1e-4)
    if crs == "EPSG:3857":
        assert site.gsd_m_per_px < 0.4  # the step of 0.5 is stretched by the latitude


def blobs(width, height):
    """Bright spots on grey at known pixels, smooth enough to be resampled."""
    centres = np.array([[x, y] for y in (40.3, 100.8, 160.1) for x in (45.2, 120.6, 201.7)])
    y, x = np.mgrid[0:height, 0:width]
    image = np.full((height, width), 60.0)
    for cx, cy in centres:
        image += 150.0 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 4.0**2))
    return np.rint(image).astype(np.uint8), centres


def centroid(site, xy):
    """Where the bright spot near a pixel really is."""
    x0, y0 = (round(v) - 16 for v in xy)
    weight = np.clip(site.gray(Window(x0, y0, 33, 33)).astype(float) - 75.0, 0.0, None)
    y, x = np.mgrid[y0 : y0 + 33, x0 : x0 + 33]
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
@pytest.mark.parametrize("crs", [UTM, "EPSG:4326", "EPSG:3857", "rotated"])
def test_features_lie_in_one_place_whatever_the_file_is_stored_in(tmp_path, crs):
    image, centres = blobs(250, 200)
    east, north = WEST + (centres[:, 0] + 0.5) * STEP_M, NORTH - (centres[:, 1] + 0.5) * STEP_M
    lon, lat = Transformer.from_crs(UTM, 4326, always_xy=True).transform(east, north)
    to = UTM if crs == "rotated" else crs
    if crs == "rotated":
        target, width, height = CORNER @ Affine.translation(-90, 20) @ Affine.rotation(-23), 350, 320
    else:
        box = (WEST, NORTH - 200 * STEP_M, WEST + 250 * STEP_M, NORTH)
        target, width, height = calculate_default_transform(UTM, crs, 250, 200, *box)
    warped, _ = reproject(
        image, np.zeros((height, width), np.uint8), src_transform=CORNER, src_crs=UTM, dst_transform=target,
        dst_crs=to, resampling=Resampling.cubic, tolerance=0.001,
    )  # fmt: skip
    site = OrthoMap.open(write(tmp_path / "map.tif", warped, crs=to, transform=target), cache_dir=tmp_path)
    assert site.info()["resampled"] == (crs in ("EPSG:4326", "rotated"))
    assert site.source_crs.to_string() == to
    for spot_lat, spot_lon in zip(lat, lon, strict=True):
        found = centroid(site, site.pixel_from_geodetic(spot_lat, spot_lon))
        error_m = site.enu_from_pixel(found) - site.frame.enu_from_geodetic(spot_lat, spot_lon)
        assert np.linalg.norm(error_m) < 0.1


def test_geographic_maps_across_the_antimeridian_and_in_the_south(tmp_path):
    fiji = {"crs": "EPSG:4326", "transform": Affine(1e-5, 0, 179.9995, 0, -1e-5, -17.0)}
    slope = write(tmp_path / "dsm.tif", np.tile(np.arange(100, dtype=np.float32), (80, 1)), **fiji)
    site = OrthoMap.open(write(tmp_path / "fiji.tif", noise(80, 100), **fiji), slope, cache_dir=tmp_path)
    assert site.crs.to_epsg() in (32701, 32760)
    assert site.info()["nodata_share"] < 0.1
    middle = np.array([site.width_px / 2, site.height_px / 2])
    assert np.allclose(site.pixel_from_geodetic(*site.geodetic_from_pixel(middle)), middle, atol=1e-5)
    beside = site.pixel_from_geodetic(np.full(2, -17.0004), np.array([179.99975, -179.99975]))
    assert np.allclose(site.surface_at(beside), [24.5, 74.5], atol=0.1)  # west of the antimeridian and east of it


# --- grey values and nodata ---------------------------------------------------------------------------------


def test_colour_becomes_luma_of_the_first_three_bands(tmp_path):
    data = noise(4, 30, 40)
    site = OrthoMap.open(write(tmp_path / "map.tif", data, photometric="minisblack"))
    luma = np.tensordot([0.299, 0.587, 0.114], data[:3].astype(float), axes=1)
    assert np.abs(site.gray(whole(site)) - luma).max() <= 1.0
    assert site.valid(whole(site)).all()


def test_colour_table_is_expanded(tmp_path):
    index = np.random.default_rng(0).integers(0, 3, (30, 40)).astype(np.uint8)
    table = {0: (10, 20, 30, 255), 1: (200, 100, 50, 255), 2: (9, 250, 9, 255)}
    site = OrthoMap.open(write(tmp_path / "map.tif", index, photometric="palette", colormap=table))
    luma = np.array([18.15, 124.2, 150.5])[index]
    assert np.abs(site.gray(whole(site)) - luma).max() <= 1.0


@pytest.mark.parametrize("dtype", ["uint16", "int16", "float32", "float64"])
def test_other_element_types_are_stretched_over_valid_pixels(tmp_path, dtype):
    ramp = np.linspace(300, 1300, 50 * 60).reshape(50, 60).astype(dtype)
    ramp[20, 20] = 30000  # an outlier must not eat the range
    if dtype.startswith("float"):
        ramp[10:15, 10:15] = np.nan
    site = OrthoMap.open(write(tmp_path / "map.tif", ramp))
    gray, valid = site.gray(whole(site)), site.valid(whole(site))
    assert gray[0, 0] == 0
    assert gray[-1, -1] == gray[20, 20] == 255
    assert abs(int(gray[25, 0]) - 127) < 4
    assert (~valid).sum() == (25 if dtype.startswith("float") else 0)


@pytest.mark.parametrize("dtype", ["complex64", "int8", "uint32"])
def test_other_element_types_are_refused(tmp_path, dtype):
    with pytest.raises(MapError, match=f"got {dtype}"):
        OrthoMap.open(write(tmp_path / "map.tif", noise(20, 20, high=100).astype(dtype)))


@pytest.mark.parametrize("how", ["tag", "alpha", "rgba", "mask"])
def test_nodata_comes_from_tag_alpha_and_mask(tmp_path, how):
    expected = np.ones((40, 50), np.bool_)
    expected[5:9, 7:20] = False
    gray, alpha = noise(40, 50), np.where(expected, 255, 0).astype(np.uint8)
    path = tmp_path / "map.tif"
    if how == "tag":
        write(path, np.where(expected, gray, 255), nodata=255)
    elif how == "alpha":
        write(path, [gray, alpha], colorinterp=(ColorInterp.gray, ColorInterp.alpha))
    elif how == "rgba":
        write(path, [gray, gray, gray, alpha], photometric="rgb", alpha="yes")
    else:
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.open(write(path, gray), "r+") as dataset:
            dataset.write_mask(expected)
    site = OrthoMap.open(path)
    assert np.array_equal(site.valid(whole(site)), expected)
    assert site.info()["nodata_share"] == pytest.approx(52 / 2000)
    assert np.array_equal(site.valid(whole(site, 1), 1), expected.reshape(20, 2, 25, 2).all(axis=(1, 3)))


@pytest.mark.parametrize("colour", [0, 255])
@pytest.mark.parametrize("bands", [1, 3])
def test_untagged_collar_is_nodata_and_dark_pixels_inside_are_not(tmp_path, colour, bands):
    data = noise(bands, 60, 80, low=5, high=250)
    data[:, :, :9] = colour
    data[:, :6, :] = colour
    expected = np.ones((60, 80), np.bool_)
    expected[:, :9] = expected[:6, :] = False
    data[:, 30:40, 40:60] = colour  # a lake or a roof: not connected to the border
    if bands == 3:
        data[:2, 20:25, 70:80] = colour  # pure in two bands only
    site = OrthoMap.open(write(tmp_path / "map.tif", data, photometric="minisblack"))
    assert np.array_equal(site.valid(whole(site)), expected)


def test_a_few_black_pixels_at_the_border_are_no_collar(tmp_path):
    data = noise(100, 100)
    data[0, :40] = 0  # 0.4 %
    site = OrthoMap.open(write(tmp_path / "map.tif", data))
    assert site.valid(whole(site)).all()


def test_a_tag_ends_the_search_for_a_collar(tmp_path):
    data = noise(50, 50)
    data[:, :5] = 0
    data[20, 20] = 255
    site = OrthoMap.open(write(tmp_path / "map.tif", data, nodata=255))
    assert site.valid(whole(site)).sum() == 50 * 50 - 1


def test_resampling_does_not_bleed_nodata_into_valid_pixels(tmp_path):
    data = np.full((80, 80), 128, np.uint8)
    data[30:50, 30:50] = 255
    site = OrthoMap.open(write(tmp_path / "map.tif", data, nodata=255, **DEGREES), cache_dir=tmp_path)
    gray, valid = site.gray(whole(site)), site.valid(whole(site))
    assert 0.7 < valid.mean() < 0.95
    assert (np.abs(gray[valid].astype(int) - 128) <= 1).all()


# --- windows and pyramid ------------------------------------------------------------------------------------


def test_window_is_a_copy_of_the_pixels(site):
    window = Window(10, 20, 33, 17)
    gray = site.gray(window)
    assert np.array_equal(gray, noise(90, 120)[20:37, 10:43])
    gray[:] = 0
    assert site.gray(window).any()


@pytest.mark.parametrize("window", [(-1, 0, 5, 5), (0, 0, 121, 5), (0, 86, 5, 5), (0, 0, 0, 5), (0, 0, 5, -1)])
def test_window_outside_is_refused(site, window):
    assert "window" in misuse(site.gray, Window(*window))


def test_level_that_does_not_exist_is_refused(site):
    for level in (-1, site.levels):
        assert "level" in misuse(site.level_shape, level)


def test_pyramid_averages_areas_and_keeps_its_pixel_convention(site):
    full, half = site.gray(whole(site)).astype(float), site.gray(whole(site, 1), 1)
    assert site.level_shape(1) == (45, 60)
    assert np.abs(full.reshape(45, 2, 60, 2).mean(axis=(1, 3)) - half).max() <= 0.5
    # Pixel 0 of level 2 averages columns 0 to 3, whose middle is 1.5.
    assert np.allclose(site.full_from_level([0, 5], 2), [1.5, 21.5])
    xy = np.array([[3.25, 7.5], [-1.0, 80.0]])
    assert np.allclose(site.full_from_level(site.level_from_full(xy, 3), 3), xy)


def test_map_too_large_for_memory_reads_the_same_from_the_file(tmp_path, monkeypatch):
    data = noise(3, 150, 203, low=5, high=250)
    data[:, :, :20] = 0
    path = write(tmp_path / "map.tif", data, photometric="rgb")
    kept = OrthoMap.open(path)
    monkeypatch.setattr("engine.maps.rasters.MEMORY_LIMIT_PX", 3000)
    monkeypatch.setattr("engine.maps.pyramid.COARSE_LIMIT_PX", 3000)
    monkeypatch.setattr("engine.maps.rasters.OVERVIEW_PX", 64)
    streamed = OrthoMap.open(path)
    assert streamed.levels == kept.levels
    for level in range(kept.levels):
        height, width = kept.level_shape(level)
        window = Window(3, 2, width - 5, height - 3)
        assert np.array_equal(streamed.gray(window, level), kept.gray(window, level))
        assert np.array_equal(streamed.valid(window, level), kept.valid(window, level))


# --- surface ------------------------------------------------------------------------------------------------


def test_surface_is_bilinear_and_ground_is_a_low_percentile(site):
    assert site.has_surface
    xy = np.array([[10.5, 20.25], [0.0, 0.0], [118.9, 88.9]])
    assert np.allclose(site.surface_at(xy), xy @ [0.25, 0.5], atol=1e-4)
    assert np.array_equal(site.surface_points(xy), np.c_[site.enu_from_pixel(xy), site.surface_at(xy)])
    corners, outside = [[-0.5, -0.5], [119.5, 89.5]], [[-0.6, 2.0], [119.6, 2.0], [2.0, -0.6], [2.0, 89.6]]
    assert np.allclose(site.surface_at(corners), [0.0, 74.25])  # pixels reach half a pixel out
    assert (site.surface_at(outside) == site.ground_m).all()
    heights = 0.25 * np.arange(120) + 0.5 * np.arange(90)[:, None]
    assert site.ground_m == pytest.approx(np.percentile(heights, 20), abs=0.5)


def test_no_surface_is_flat_ground_at_zero():
    site = OrthoMap.from_arrays(noise(20, 20), CENTRED, UTM)
    assert not site.has_surface
    assert site.ground_m == 0.0
    assert np.array_equal(site.surface_at([[3, 4], [900, 900]]), [0, 0])


@pytest.mark.parametrize("crs", [UTM, "EPSG:4326", "EPSG:3857"])
@pytest.mark.parametrize("dtype", ["float32", "int16"])
def test_surface_of_another_grid_lies_at_the_same_place(tmp_path, crs, dtype):
    """A plane in latitude and longitude stays a plane on every grid that is used here."""
    path = write(tmp_path / "map.tif", noise(100, 100))
    site = OrthoMap.open(path)
    to_crs = Transformer.from_crs(4326, crs, always_xy=True)
    west, south, east, north = site.bounds_deg
    (x0, x1), (_, y1) = to_crs.transform(np.array([west, east]), np.array([south, north]))
    step = (x1 - x0) / 30
    transform = Affine(step, 0, x0 - 5 * step, 0, -step, y1 + 5 * step)
    rows, columns = np.mgrid[0:50, 0:40] + 0.5
    lon, lat = to_crs.transform(*(transform @ (columns, rows)), direction="INVERSE")

    def plane(lat_deg, lon_deg):
        return 500 + (np.asarray(lon_deg) - west) * 4e5 + (np.asarray(lat_deg) - south) * 9e5

    heights = plane(lat, lon)
    surface = write(tmp_path / "dsm.tif", np.rint(heights).astype(dtype), crs=crs, transform=transform)
    site = OrthoMap.open(path, surface)
    xy = np.random.default_rng(2).uniform(0, 99, (200, 2))
    off_m = site.surface_at(xy) - plane(*site.geodetic_from_pixel(xy))
    assert np.abs(off_m).max() < 1.0
    assert abs(off_m.mean()) < 0.1


@pytest.mark.parametrize("nodata", [None, -9999.0, float("nan")])
def test_surface_nodata_and_what_lies_outside_is_ground(tmp_path, nodata):
    heights = np.full((40, 40), 100.0, np.float32)
    heights[:, :20] = 40.0
    heights[10:20, 10:25] = -9999.0 if nodata is None else nodata  # an untagged -9999 is no height either
    path = write(tmp_path / "map.tif", noise(60, 60))
    site = OrthoMap.open(path, write(tmp_path / "dsm.tif", heights, nodata=nodata))
    assert site.ground_m == 40.0
    at = [[30, 5], [24.5, 15], [22, 9.5], [22, 19.5], [15, 15], [50, 5], [5, 50]]  # by nodata, in it and outside
    assert site.surface_at(at).tolist() == [100, 40, 40, 40, 40, 40, 40]
    assert site.info()["surface_range_m"] == [40.0, 100.0]


def test_surface_that_lies_elsewhere_or_knows_nothing_is_refused(tmp_path):
    path = write(tmp_path / "map.tif", noise(60, 60))
    beside = CORNER @ Affine.translation(1800, 0)
    far = write(tmp_path / "far.tif", np.ones((9, 9), np.float32), transform=beside)
    empty = write(tmp_path / "empty.tif", np.full((60, 60), np.nan, np.float32))
    for surface in (far, empty):
        assert "surface" in refusal(OrthoMap.open, path, surface, error=MapError)
    with pytest.raises(MapError, match=r"surface: .*does not exist"):
        OrthoMap.open(path, tmp_path / "none.tif")


def test_a_picture_is_no_surface(tmp_path):
    """The map given twice: its red would be read as heights of up to 255 m."""
    path = write(tmp_path / "map.tif", np.stack([noise(60, 60)] * 3))
    with pytest.raises(MapError, match=r"surface: expected one band of heights, got a picture of 3 bands"):
        OrthoMap.open(path, path)


# --- pictures with a place ----------------------------------------------------------------------------------


@pytest.mark.parametrize("driver", ["PNG", "JPEG", "BMP", "WEBP", "JP2OpenJPEG"])
def test_picture_with_bounds(tmp_path, driver):
    image = np.repeat(blobs(120, 100)[0][None], 3, axis=0)
    path = write(tmp_path / "picture", image, driver=driver, crs=None, transform=None)
    bounds = (33.0, 32.0, 33.001, 32.0008)
    site = OrthoMap.open(path, bounds_deg=bounds, cache_dir=tmp_path / "cache")
    assert np.allclose(site.bounds_deg, bounds, atol=3e-5)
    # The first bright spot sits at (45.2, 40.3) of the picture, counted from pixel centres.
    lat, lon = 32.0008 - 0.0008 * 40.8 / 100, 33.0 + 0.001 * 45.7 / 120
    found = centroid(site, site.pixel_from_geodetic(lat, lon))
    assert np.linalg.norm(site.enu_from_pixel(found) - site.frame.enu_from_geodetic(lat, lon)) < 0.15


@pytest.mark.parametrize(("ending", "driver"), [("pgw", "PNG"), ("jgw", "JPEG"), ("wld", "PNG"), ("tfw", "GTiff")])
def test_world_file_counts_from_the_centre_of_the_first_pixel(tmp_path, ending, driver):
    path = tmp_path / {"PNG": "p.png", "JPEG": "p.jpg", "GTiff": "p.tif"}[driver]
    write(path, noise(60, 70), driver=driver, crs=None, transform=None)
    path.with_suffix(f".{ending}").write_text(f"0.5\n0\n0\n-0.5\n{WEST + 0.25}\n{NORTH - 0.25}\n")
    assert "give `crs`" in refusal(OrthoMap.open, path, error=MapError)
    site = OrthoMap.open(path, crs=UTM)
    lon, lat = Transformer.from_crs(UTM, 4326, always_xy=True).transform(WEST + 0.25, NORTH - 0.25)
    assert np.allclose(site.pixel_from_geodetic(lat, lon), [0, 0], atol=1e-6)
    path.with_suffix(".prj").write_text(site.crs.to_wkt("WKT1_ESRI"))
    assert OrthoMap.open(path).crs.equals(site.crs, ignore_axis_order=True)


@pytest.mark.parametrize(
    ("options", "words"),
    [({}, "bounds_deg.*world file"), ({"bounds_deg": (33, 32, np.nan, 32.1)}, "west < east")],
)
def test_picture_without_a_place_is_refused(tmp_path, options, words):
    path = write(tmp_path / "p.png", noise(60, 70), driver="PNG", crs=None, transform=None)
    with pytest.raises(MapError, match=words):
        OrthoMap.open(path, **options)


# --- refusals -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        ({"transform": None}, "without georeference"),
        ({"transform": Affine(float("nan"), 0, 0, 0, -1, 0)}, "geotransform"),
        ({"transform": Affine(1, 1, 0, 1, 1, 5)}, "geotransform"),
        ({"transform": Affine(0.5, 0, 1e12, 0, -0.5, 1e12)}, "outside its CRS"),
        ({"transform": Affine(1e-6, 0, 35.0, 0, -1e-6, 32.0)}, "is its CRS right"),
        ({"crs": "EPSG:4326", "transform": Affine(0.5, 0, 1e5, 0, -0.5, 1e5)}, "outside its CRS"),
        ({"crs": "EPSG:4326", "transform": Affine(3, 0, -180, 0, -1.8, 90)}, "UTM grid"),
        ({"crs": rasterio.CRS.from_wkt('LOCAL_CS["site",UNIT["metre",1]]')}, "on the Earth"),
        ({"crs": rasterio.CRS.from_string("+proj=longlat +R=1737400")}, "of the Earth"),
    ],
)
def test_georeference_that_makes_no_sense_is_refused(tmp_path, profile, words):
    path = write(tmp_path / "map.tif", noise(60, 120), **profile)
    assert words in refusal(OrthoMap.open, path, cache_dir=tmp_path, error=MapError)


def test_what_is_no_local_raster_is_refused(tmp_path):
    good = write(tmp_path / "good.tif", noise(20, 20))
    for name, content in (("text.tif", "hello"), ("empty.tif", "")):
        (tmp_path / name).write_text(content)
        assert "expected a raster" in refusal(OrthoMap.open, tmp_path / name, error=MapError)
    elsewhere = ("https://example.org/a.tif", f"/vsizip/{good}", f"GTIFF_DIR:1:{good}", "none.tif", "", "a\0b")
    for path in elsewhere:
        assert "local file" in refusal(OrthoMap.open, path, error=MapError)


@pytest.mark.parametrize("share", [0.001, 0.01, 0.3, 0.9, 0.999])
def test_truncated_file_is_refused(tmp_path, share):
    path = write(tmp_path / "map.tif", noise(3, 300, 300), tiled=True, compress="deflate", photometric="rgb")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert "map" in refusal(OrthoMap.open, path, error=MapError)


def test_map_of_nothing_but_nodata_is_refused(tmp_path):
    with pytest.raises(MapError, match="valid pixel"):
        OrthoMap.open(write(tmp_path / "map.tif", np.zeros((30, 30), np.uint8)))


def test_odd_file_names_and_sizes_open(tmp_path):
    assert OrthoMap.open(write(tmp_path / "a#b?c !d.tif", noise(1, 1))).level_shape(0) == (1, 1)
    assert OrthoMap.open(str(write(tmp_path / "row.tif", noise(1, 63)))).levels == 1


@pytest.mark.parametrize(
    ("changed", "error"),
    [
        ({"gray": noise(3, 20, 20)}, ShapeError),
        ({"gray": noise(20, 20).astype(np.float32)}, DtypeError),
        ({"valid": np.ones((20, 19), np.bool_)}, ShapeError),
        ({"surface_m": np.ones((19, 20), np.float32)}, ShapeError),
        ({"pixel_to_crs": np.eye(3)}, MapError),
        ({"pixel_to_crs": np.zeros((2, 3))}, MapError),
        ({"pixel_to_crs": [[0.4, 0.3, WEST], [0.3, -0.4, NORTH]]}, MapError),
        ({"crs": "EPSG:4326", "pixel_to_crs": [[1e-5, 0, 33], [0, -1e-5, 32]]}, MapError),
        ({"crs": "nonsense"}, MapError),
    ],
)
def test_arrays_that_are_no_map_are_refused(changed, error):
    with pytest.raises(error):
        OrthoMap.from_arrays(**{"gray": noise(20, 20), "pixel_to_crs": CENTRED, "crs": UTM} | changed)


# --- cache --------------------------------------------------------------------------------------------------


@pytest.fixture
def geographic(tmp_path):
    return write(tmp_path / "map.tif", noise(80, 90), **DEGREES)


@pytest.mark.parametrize("opened", ["map.tif", "."], ids=["file", "folder of tiles"])
def test_resampled_map_is_made_once_and_again_for_other_content(tmp_path, geographic, opened):
    path, cache = tmp_path / opened, tmp_path / "cache"
    first = OrthoMap.open(path, cache_dir=cache)
    (made,) = cache.glob("*/*.tif")
    stamp = made.stat().st_mtime_ns
    second = OrthoMap.open(path, cache_dir=cache)
    assert [p.stat().st_mtime_ns for p in cache.glob("*/*.tif")] == [stamp]
    assert np.array_equal(first.gray(whole(first)), second.gray(whole(second)))
    write(geographic, noise(80, 90, seed=5), **DEGREES)
    OrthoMap.open(path, cache_dir=cache)
    assert len(list(cache.glob("*/*.tif"))) == 2


def test_cache_that_cannot_be_written_does_not_matter(tmp_path, geographic, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    assert OrthoMap.open(geographic, cache_dir=blocked).info()["resampled"]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    OrthoMap.open(geographic)
    assert len(list((tmp_path / "xdg" / "scenematch").iterdir())) == 1


# --- the flights --------------------------------------------------------------------------------------------


def test_info_can_be_written_as_json(tmp_path, geographic, site):
    facts = json.loads(json.dumps(OrthoMap.open(geographic, cache_dir=tmp_path).info()))
    assert (facts["driver"], facts["bands"], facts["source_crs"]) == ("GTiff", 1, "EPSG:4326")
    facts = json.loads(json.dumps(site.info()))
    assert facts["surface_range_m"] == [0.0, pytest.approx(74.25)]
    convergence_deg = Proj(UTM).get_factors(site.frame.lon_deg, site.frame.lat_deg).meridian_convergence
    assert facts["convergence_deg"] == pytest.approx(convergence_deg, abs=1e-4)


def test_satellite_map_with_a_colour_table_and_a_black_collar(shared):
    site = OrthoMap.open(shared / "nust" / "map.tif")
    valid = site.valid(whole(site))
    assert 0.3 < 1.0 - valid.mean() < 0.4
    assert (site.gray(whole(site))[~valid] == 0).all()  # index 255 of the table, which stands for black


# ----------------------------------------------------------------------------------- how well it says that it lies


@pytest.mark.parametrize("epsg", [32633, 4326])
def test_a_map_says_how_well_it_lies_and_its_surface_how_it_leans(tmp_path, epsg):
    """Also where it is resampled; what the caller says counts more."""
    step, west, north = (0.5, 5e5, 5.3e6) if epsg == 32633 else (5e-6, 15.0, 47.8)
    affine = [[step, 0.0, west], [0.0, -step, north]]
    write_geotiff(tmp_path / "map.tif", noise(40, 50), affine, epsg, tags={GEOREFERENCE_TAG: 0.12})
    write_geotiff(tmp_path / "dsm.tif", np.ones((40, 50), np.float32), affine, epsg, tags={SLOPE_TAG: 0.04})

    def opened(**said):
        site = OrthoMap.open(tmp_path / "map.tif", tmp_path / "dsm.tif", cache_dir=tmp_path / "cache", **said)
        return site.georeference_sigma_m, site.slope_sigma_deg

    assert opened() == opened() == (0.12, 0.04)
    assert opened(georeference_sigma_m=2.0, slope_sigma_deg=0.5) == (2.0, 0.5)
    write_geotiff(tmp_path / "map.tif", noise(40, 50), affine, epsg)
    write_geotiff(tmp_path / "dsm.tif", np.ones((40, 50), np.float32), affine, epsg)
    assert opened() == (None, None)  # of files that say nothing


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "1e200", "half a metre"])
def test_an_accuracy_that_is_no_number_above_0_is_refused(tmp_path, text):
    write_geotiff(tmp_path / "map.tif", noise(40, 50), CENTRED, 32633, tags={GEOREFERENCE_TAG: text})
    with pytest.raises(MapError, match=rf"and at most 1e.06 as {GEOREFERENCE_TAG}, got '{text}'"):
        OrthoMap.open(tmp_path / "map.tif")
    if text != "half a metre":
        with pytest.raises(OptionError, match="georeference_sigma_m: expected a number above 0"):
            OrthoMap.from_arrays(noise(20, 20), CENTRED, UTM, georeference_sigma_m=float(text))


def test_what_stands_at_a_wall_is_not_to_be_relied_on():
    """A house of 10 m over level ground: full weight away from its walls, 1 / (1 + 10^2) within reach of them."""
    heights = np.zeros((60, 60), np.float32)
    heights[20:40, 20:40] = 10.0
    site = OrthoMap.from_arrays(noise(60, 60), CENTRED, UTM, surface_m=heights)
    at = np.array([[5.0, 5.0], [30.0, 30.0], [20.0, 30.0], [18.0, 30.0], [17.0, 30.0]])
    np.testing.assert_allclose(site.roughness_weight_at(at, 2.0), [1.0, 1.0, 1 / 101, 1 / 101, 1.0], rtol=1e-9)
    assert OrthoMap.from_arrays(noise(60, 60), CENTRED, UTM).roughness_weight_at(at, 2.0).tolist() == [1.0] * 5


@pytest.mark.parametrize(
    ("crs", "datum"),
    [
        ("EPSG:32633+5773", "EGM96 height"),
        ("EPSG:32633", None),
        ("EPSG:32633+6360", None),  # feet, where heights are taken for metres
        ("EPSG:4979", None),  # above the ellipsoid
    ],
)
def test_a_surface_is_above_the_sea_where_its_crs_says_so(tmp_path, crs, datum):
    place = DEGREES if crs == "EPSG:4979" else {"crs": "EPSG:32633"}
    ortho = write(tmp_path / "map.tif", noise(40, 50), **place)
    surface = write(tmp_path / "dsm.tif", np.full((40, 50), 150.0, np.float32), **place | {"crs": crs})
    site = OrthoMap.open(ortho, surface, cache_dir=tmp_path / "cache")
    assert site.surface_datum == site.info()["surface_datum"] == datum
