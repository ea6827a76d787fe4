"""The paper's stack for ROS 1 and 2: its files agree with each other, with the camera, the map and the node."""

import importlib.machinery
import importlib.util
import re
import sys
from types import ModuleType, SimpleNamespace
from unittest.mock import Mock
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from engine import Camera, OptionError, OrthoMap
from engine.geo import LocalFrame
from scenematch.bridges.ros import RosTopics
from scenematch.bridges.vehicle import NedOrigin, north_east_m
from scenematch.files.geotiff import write_geotiff
from scenematch.files.quaternions import quaternion_xyzw
from tests.support.paths import ROOT
from tests.support.ros import maker_of, written

STACK, ROS2 = ROOT / "examples" / "paper-stack", ROOT / "examples" / "ros2"
SUFFIXES = (".launch", ".world", ".sdf", ".xml", ".config")
FILES = sorted(f for f in STACK.rglob("*") if f.suffix in SUFFIXES)
FILES2 = sorted(f for f in ROS2.rglob("*") if f.suffix in SUFFIXES)


@pytest.mark.parametrize("file", [*FILES, *FILES2], ids=lambda f: f"{f.parent.name}/{f.name}")
def test_files_are_well_formed(file):
    root = ElementTree.parse(file).getroot()
    assert root.tag.rpartition("}")[2] in {"launch", "sdf", "model", "package", "CycloneDDS"}


def test_files_that_are_named_are_there():
    """What the launch files and the world take from this package."""
    text = "".join(f.read_text(encoding="utf-8") for f in FILES)
    for name in re.findall(r"\$\(find scenematch_ros\)/([\w./]+)", text):
        assert (STACK / name).is_file(), name
    models = {"iris_with_ardupilot", "iris_with_nadir_camera", "map_ground"}
    assert set(re.findall(r"model://(\w+)<", text)) == models
    for kind in re.findall(r'pkg="scenematch_ros" type="(\w+)"', text):
        assert (STACK / "scripts" / kind).stat().st_mode & 0o111
    installed = (STACK / "CMakeLists.txt").read_text(encoding="utf-8")
    named = ("CMakeLists.txt", "package.xml", "scripts", "__pycache__")  # the last is python's own
    for name in STACK.iterdir():
        assert name.name in installed or name.name in named
    for script in (STACK / "scripts").iterdir():
        assert f"scripts/{script.name}" in installed or script.is_dir()


def test_files_that_the_package_of_ros_2_names_are_there():
    text = "".join(f.read_text(encoding="utf-8") for f in [*FILES2, *(ROS2 / "launch").glob("*.py")])
    for folder, name in re.findall(r'"(config|worlds|launch)", "([\w.]+)"\)', text):
        if name not in ("gz_sim.launch.py",):
            assert (ROS2 / folder / name).is_file(), name
    for entry in re.findall(r"= \{NAME\}\.(\w+):main", (ROS2 / "setup.py").read_text(encoding="utf-8")):
        assert "def main" in (ROS2 / "scenematch_ros" / f"{entry}.py").read_text(encoding="utf-8")


def quarter_turns(pose):
    """Yaw of an SDF pose in quarter turns."""
    return round(float(pose.split()[5]) / (np.pi / 2.0), 6)


def test_the_nose_is_north_and_the_ground_is_under_it_as_each_plugin_has_its_world():
    """Gazebo classic's plugin takes x for north and y for west, Harmonic's takes x for east and y for north."""
    classic = ElementTree.parse(STACK / "worlds/paper.world").getroot()
    poses = {i.findtext("uri"): quarter_turns(i.findtext("pose")) for i in classic.iter("include")}
    assert poses == {"model://map_ground": -1.0, "model://iris_with_nadir_camera": 0.0}
    harmonic = ElementTree.parse(ROS2 / "worlds/paper.sdf").getroot()
    assert [i.findtext("pose") for i in harmonic.iter("include")] == [None]
    assert '"-Y", "1.5707963267948966"' in (ROS2 / "launch/paper_stack.launch.py").read_text(encoding="utf-8")


def test_steps_are_short_enough_for_arducopters_loop():
    for path in (STACK / "worlds/paper.world", ROS2 / "worlds/paper.sdf"):
        assert float(ElementTree.parse(path).getroot().find(".//physics/max_step_size").text) <= 1.0 / 800.0


def test_the_topics_of_the_bridge_are_those_of_the_models_and_the_node():
    bridged = {row["ros_topic_name"]: row for row in yaml.safe_load((ROS2 / "config/bridge.yaml").read_text())}
    model = ElementTree.parse(ROS2 / "models/iris_with_nadir_camera/model.sdf").getroot()
    published = {model.findtext(".//sensor/topic"), model.findtext(".//camera_info_topic"), "/clock",
                 model.findtext(".//odom_topic")}  # fmt: skip
    assert {row["gz_topic_name"] for row in bridged.values()} == published
    stated = yaml.safe_load((ROS2 / "config/node.yaml").read_text())["/**"]["ros__parameters"]
    for name in RosTopics.__slots__:
        assert stated[f"{name}_topic"] == getattr(RosTopics(), name)
    assert {stated["image_topic"], stated["camera_info_topic"]} <= set(bridged)


class Parameters:
    """A node that has only parameters."""

    def __init__(self, **given):
        self.given, self.asked = given, {}

    def parameter(self, name, default):
        self.asked[name] = default
        return self.given.get(name, default)


def loaded(path):
    """A script of the stack as a module, whatever its name."""
    loader = importlib.machinery.SourceFileLoader(f"stack_{path.stem}", str(path))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader(loader.name, loader))
    loader.exec_module(module)
    return module


def test_the_node_of_ros_2_takes_the_parameters_of_its_file():
    module = loaded(ROS2 / "scenematch_ros/node.py")
    node = Parameters(map="site.tif", method="ncc", image_topic="down/image_raw", deadline_ms=200.0)
    ros, matching = module.settings_of(node)
    assert (str(ros.map.map), ros.version, ros.topics.image, matching.method, matching.deadline_ms) == (
        "site.tif", 2, "down/image_raw", "ncc", 200.0)  # fmt: skip
    stated = yaml.safe_load((ROS2 / "config/node.yaml").read_text())["/**"]["ros__parameters"]
    assert {**node.asked, "threads": 1} == stated  # names, types and defaults; threads is asked for by main
    assert {name: type(value) for name, value in node.asked.items()} == {
        name: type(value) for name, value in stated.items() if name != "threads"}  # fmt: skip
    with pytest.raises(OptionError, match="map: expected a file"):
        module.settings_of(Parameters())


def test_the_node_of_ros_2_goes_on_when_its_launcher_has_ended(monkeypatch):
    closed = Mock(write=Mock(side_effect=BrokenPipeError))
    monkeypatch.setattr(sys, "stdout", closed)
    loaded(ROS2 / "scenematch_ros/node.py").Printed().message("nobody reads this")
    assert closed.write.called


@pytest.mark.parametrize("stack", [STACK, ROS2], ids=["classic", "harmonic"])
def test_the_simulated_camera_is_the_calibrated_one(stack):
    camera = Camera.load(STACK / "camera.yaml")
    link = ElementTree.parse(stack / "models/iris_with_nadir_camera/model.sdf").getroot().find(".//link")
    size = [int(link.findtext(f".//image/{side}")) for side in ("width", "height")]
    assert size == [camera.width_px, camera.height_px] == [300, 300]
    focal_px = 150.0 / np.tan(float(link.findtext(".//horizontal_fov")) / 2.0)
    assert camera.matrix[0, 0] == camera.matrix[1, 1] == pytest.approx(focal_px)
    turn = Rotation.from_euler("xyz", [float(v) for v in link.findtext("pose").split()[3:]]).as_matrix()
    # Gazebo's camera looks along x, with z up in the picture and y to its left; its body is forward-left-up.
    optical = np.stack([-turn[:, 1], -turn[:, 2], turn[:, 0]], axis=1)
    assert np.allclose(np.diag([1.0, -1.0, -1.0]) @ optical, camera.mount, atol=1e-9)


@pytest.fixture(scope="module")
def ground(tmp_path_factory, sim_town):
    """The model of a simulated town, the map that it was made of, and the mesh as a reader of the file has it."""
    module = loaded(STACK / "make_world.py")
    folder = tmp_path_factory.mktemp("world")
    for name, raster in (("map", sim_town.ortho), ("dsm", sim_town.surface_m.astype(np.float32))):
        write_geotiff(folder / f"{name}.tif", raster, sim_town.pixel_to_crs, sim_town.crs_epsg)
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
    assert (picture.min(), picture.max()) == (0.0, 1.0)
    a, b, c = (places[faces[:, k], :2] for k in range(3))
    area_m2 = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (area_m2 > 0).all()  # seen from above
    extent_m2 = site.width_px * site.height_px * site.gsd_m_per_px**2
    assert area_m2.sum() == pytest.approx(extent_m2, rel=0.01)  # ArduPilot's sphere is no more than that off


def test_the_picture_is_the_maps(ground, sim_town):
    from PIL import Image

    folder, _ = ground
    assert np.array_equal(np.asarray(Image.open(folder / "materials/textures/map.png")), sim_town.ortho)
    for name in ("model.sdf", "model-harmonic.sdf", "model.config"):
        ElementTree.parse(folder / name)
    material = (folder / "meshes/ground.mtl").read_text(encoding="utf-8")
    named = re.search(r"map_Kd (\S+)", material).group(1)
    assert (folder / "meshes" / named).resolve() == (folder / "materials/textures/map.png").resolve()


@pytest.fixture
def truth_script(monkeypatch):
    """scripts/truth without ROS."""
    packages = {"rospy": [], "geometry_msgs": ["Quaternion"], "nav_msgs": ["Odometry"],
                "sensor_msgs": ["Imu", "NavSatFix"], "std_msgs": ["Float64"]}  # fmt: skip
    for name, classes in packages.items():
        messages = ModuleType(f"{name}.msg")
        vars(messages).update(dict.fromkeys(classes, SimpleNamespace))
        for module in (ModuleType(name), messages):
            monkeypatch.setitem(sys.modules, module.__name__, module)
    return loaded(STACK / "scripts/truth")


def test_the_truth_is_the_vehicles_in_degrees_as_ardupilot_has_them(truth_script):
    origin = NedOrigin(32.794, 34.9896, 0.0)
    place = truth_script.geodetic(310.0, -420.0, origin.lat_deg, origin.lon_deg)
    assert north_east_m(*place, origin, "ardupilot") == pytest.approx((310.0, -420.0), abs=1e-3)


def test_the_truths_attitude_is_turned_from_north_west_to_east_north(truth_script):
    for roll, pitch, heading in ((0, 0, 0), (0, 0, 90), (5, -7, 200), (20, 10, 300)):
        wanted = Rotation.from_quat(quaternion_xyzw(roll, pitch, heading))
        x, y, z, w = (Rotation.from_euler("z", -90, degrees=True) * wanted).as_quat()
        turned = truth_script.from_north_west(SimpleNamespace(x=x, y=y, z=z, w=w))
        back = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w])
        assert (back * wanted.inv()).magnitude() == pytest.approx(0.0, abs=1e-9)


def test_positions_in_a_bag_are_compared_with_its_truth(tmp_path, capsys, monkeypatch):
    maker, frame, stamps_ns = maker_of("ros1"), LocalFrame(48.0, 15.0), [10**9 + k * 10**8 for k in range(20)]
    off_m = {"/truth/fix": 0.0, "/scenematch/fix": 1.5, "/mavros/global_position/global": 6.0}
    off_m["/mavros/global_position/raw/fix"] = 0.5  # which repeats each position once
    topics = {"/truth/height_agl": [(time_ns, maker.float64(100.0)) for time_ns in stamps_ns]}
    for topic, north_m in off_m.items():
        each = 2 if topic.endswith("raw/fix") else 1
        places = [map(float, frame.geodetic_from_enu(7.0 * (k - k % each), north_m)) for k in range(20)]
        stamped = zip(stamps_ns, places, strict=True)
        topics[topic] = [(t, maker.position(t, "", *at, np.eye(3))) for t, at in stamped]
    written(tmp_path / "flight.bag", topics)
    monkeypatch.setattr(sys, "argv", ["compare", str(tmp_path / "flight.bag")])
    loaded(STACK / "scripts/compare").main()
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()[1:]]
    assert [(row[0], row[1], row[2], row[3], row[-1]) for row in rows] == [
        ("scenematch", "20", "10.0", "1.50", "0"),
        ("the autopilot's estimate", "20", "10.0", "6.00", "20"),
        ("its GPS receiver", "10", "5.0", "0.50", "0"),
    ]
