"""The paper's stack: its files are well-formed, its camera is the calibrated one, its ground is the map."""

from __future__ import annotations

import importlib.util
import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from engine.camera import Camera
from engine.formats.geotiff import write_geotiff
from engine.orthomap import OrthoMap
from tests.support.paths import ROOT

STACK = ROOT / "examples" / "paper-stack"
FILES = sorted(f for f in STACK.rglob("*") if f.suffix in (".launch", ".world", ".sdf", ".xml", ".config"))


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.name)
def test_files_are_well_formed(file):
    root = ElementTree.parse(file).getroot()
    assert root.tag in {"launch", "sdf", "model", "package"}


def test_files_that_are_named_are_there():
    """What the launch files and the world take from this package."""
    text = "".join(f.read_text(encoding="utf-8") for f in FILES)
    for name in re.findall(r"\$\(find scenematch_ros\)/([\w./]+)", text):
        assert (STACK / name).is_file(), name
    assert set(re.findall(r"model://(\w+)<", text)) == {
        "iris_with_ardupilot",
        "iris_with_nadir_camera",
        "map_ground",
    }
    for kind in re.findall(r'type="(scenematch\w*)"', text):
        assert (STACK / "scripts" / kind).stat().st_mode & 0o111


def test_the_simulated_camera_is_the_calibrated_one():
    camera = Camera.load(STACK / "camera.yaml")
    link = ElementTree.parse(STACK / "models/iris_with_nadir_camera/model.sdf").getroot().find(".//link")
    size = [int(link.findtext(f".//image/{side}")) for side in ("width", "height")]
    assert size == [camera.width_px, camera.height_px] == [300, 300]
    focal_px = 150.0 / math.tan(float(link.findtext(".//horizontal_fov")) / 2.0)
    assert camera.matrix[0, 0] == camera.matrix[1, 1] == pytest.approx(focal_px)
    turn = Rotation.from_euler("xyz", [float(v) for v in link.findtext("pose").split()[3:]]).as_matrix()
    # Gazebo's camera looks along x, with z up in the picture and y to its left; its body is forward-left-up.
    optical = np.stack([-turn[:, 1], -turn[:, 2], turn[:, 0]], axis=1)
    assert np.allclose(np.diag([1.0, -1.0, -1.0]) @ optical, camera.mount, atol=1e-9)


@pytest.fixture(scope="module")
def ground(tmp_path_factory, sim_town):
    """The model of a simulated town, the map that it was made of, and the mesh as a reader of the file has it."""
    spec = importlib.util.spec_from_file_location("make_world", STACK / "make_world.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    folder = tmp_path_factory.mktemp("world")
    write_geotiff(folder / "map.tif", sim_town.ortho, sim_town.pixel_to_crs, sim_town.crs_epsg)
    write_geotiff(
        folder / "dsm.tif", sim_town.surface_m.astype(np.float32), sim_town.pixel_to_crs, sim_town.crs_epsg
    )
    site = module.write_ground(folder / "map.tif", folder / "dsm.tif", folder / "models", 64)
    return folder / "models" / "map_ground", site


def mesh(folder):
    rows = [line.split() for line in (folder / "meshes/ground.obj").read_text(encoding="utf-8").splitlines()]
    places, picture = (np.array([r[1:] for r in rows if r[0] == key], float) for key in ("v", "vt"))
    faces = np.array([[int(part.split("/")[0]) - 1 for part in r[1:]] for r in rows if r[0] == "f"])
    return places, picture, faces


def test_the_ground_is_the_map(ground):
    folder, site = ground
    assert isinstance(site, OrthoMap)
    places, picture, faces = mesh(folder)
    xy = np.column_stack([picture[:, 0] * site.width_px, (1.0 - picture[:, 1]) * site.height_px]) - 0.5
    scale = 0.011131884502145034e7  # of ArduPilot's Location, metres a degree
    lat = site.frame.lat_deg + places[:, 1] / scale
    middle = np.radians((lat + site.frame.lat_deg) / 2.0)
    lon = site.frame.lon_deg + places[:, 0] / scale / np.cos(middle)
    assert np.abs(site.pixel_from_geodetic(lat, lon) - xy).max() < 0.01
    assert np.abs(site.surface_at(xy) - site.ground_m - places[:, 2]).max() < 0.01
    assert picture.min() == 0.0
    assert picture.max() == 1.0
    a, b, c = (places[faces[:, k], :2] for k in range(3))
    area_m2 = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (area_m2 > 0).all()  # seen from above
    extent_m2 = site.width_px * site.height_px * site.gsd_m_per_px**2
    assert area_m2.sum() == pytest.approx(extent_m2, rel=0.01)  # ArduPilot's sphere is no more than that off


def test_the_picture_is_the_maps(ground, sim_town):
    from PIL import Image

    folder, _ = ground
    assert np.array_equal(np.asarray(Image.open(folder / "materials/textures/map.png")), sim_town.ortho)
    for name in ("model.sdf", "model.config"):
        ElementTree.parse(folder / name)
    material = (folder / "meshes/ground.mtl").read_text(encoding="utf-8")
    named = re.search(r"map_Kd (\S+)", material).group(1)
    assert (folder / "meshes" / named).resolve() == (folder / "materials/textures/map.png").resolve()
