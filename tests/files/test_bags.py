"""Bags of ROS 1 and ROS 2: the same pictures and numbers in every format, in and out; damage in one line."""

import io
from functools import cache, partial

import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode
from rosbags.serde import utils as serde_utils

from bench.inputs.bags import BAG_KINDS, write_bag
from engine import Camera, TelemetryError
from engine.values import Frame, Prior, Truth
from scenematch.files.flight import open_flight
from scenematch.files.logs.readers import open_truth
from scenematch.files.ros.bags import CAMERA_INFO, IMAGE, BagFrames, is_bag, read_bag, read_bag_camera
from scenematch.runs.inputs import FlightFiles
from tests.support.odometries import odometry_message
from tests.support.refusals import refusal
from tests.support.ros import maker_of, written

STEP_NS = 100_000_000
compiled = cache(partial(compile, filename="<message>", mode="exec"))
CAMERA = Camera(
    31, 23, np.array([[40.5, 0, 15.25], [0, 41.0, 10.75], [0, 0, 1]]), "plumb_bob",
    np.array([0.1, -0.02, 1e-3, 2e-3, 0.0]),
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _code_of_messages_compiled_once():
    """Every reader and writer generates the same code of a message's type; compiling takes half their time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serde_utils, "exec", lambda code, names: exec(compiled(code), names), raising=False)
        yield


def a_flight(count=5):
    rng = np.random.default_rng(3)
    frames = [
        Frame(
            rng.integers(0, 256, (23, 31, 3), dtype=np.uint8),
            timestamp_ns=1_700_000_000_123_456_789 + k * STEP_NS,
            height_agl_m=120.0 + k,
            heading_deg=(357.0 + 2.0 * k) % 360.0,
            roll_deg=3.0 * k - 5.0,
            pitch_deg=-2.0 * k,
            east_velocity_mps=0.5 * k,
            north_velocity_mps=-1.5,
        )
        for k in range(count)
    ]
    truth = [
        Truth(
            timestamp_ns=frame.timestamp_ns, lat_deg=48.2 + k * 1e-6, lon_deg=15.1 - k * 1e-6,
            alt_amsl_m=400.0 + k, height_agl_m=121.0 + k, roll_deg=1.0, pitch_deg=-1.0, heading_deg=10.0 * k,
        )
        for k, frame in enumerate(frames)
    ]  # fmt: skip
    return frames, truth


COMPARED = "height_agl_m", "roll_deg", "pitch_deg", "heading_deg", "east_velocity_mps", "north_velocity_mps"


def a_bag(folder, kind, count=5):
    path = folder / ("flight.bag" if kind == "ros1" else kind)
    frames, truth = a_flight(count)
    start = Prior(lat_deg=48.2001, lon_deg=15.1001, sigma_m=12.0)
    write_bag(path, ((f, start if k == 0 else None) for k, f in enumerate(frames)), CAMERA, kind=kind, truth=truth)
    return path, frames, truth


@pytest.fixture(scope="module", params=BAG_KINDS)
def bag(request, tmp_path_factory):
    """A bag of each kind, to be read and not written, with the frames and truth in it."""
    return a_bag(tmp_path_factory.mktemp("bag"), request.param)


def test_pictures_come_back_byte_for_byte(bag):
    path, frames, _ = bag
    source = BagFrames(path)
    assert source.stamps_ns() == [frame.timestamp_ns for frame in frames]
    for k in (0, 1, 4, 2, 2):  # forward, and back
        assert source.read(str(k)).tobytes() == frames[k].image.tobytes()


def test_a_flight_comes_back(bag):
    path, frames, truth = bag
    files = FlightFiles.from_flat(map="m.tif", frames=path, truth=path)
    flight = files.open_flight()
    camera = files.load_camera(flight)
    assert (camera.width_px, camera.height_px, camera.distortion_model) == (31, 23, "plumb_bob")
    assert np.array_equal(camera.matrix, CAMERA.matrix)
    assert np.array_equal(camera.distortion, CAMERA.distortion)
    assert len(flight) == len(frames)
    for k, (item, frame) in enumerate(zip(flight, frames, strict=True)):
        assert item.frame.timestamp_ns == frame.timestamp_ns
        for name in COMPARED:
            assert getattr(item.frame, name) == pytest.approx(getattr(frame, name), abs=1e-9)
        assert (item.prior is not None) == (k <= 1)  # a position holds for a tenth of a second
    prior = next(iter(flight)).prior
    assert (prior.lat_deg, prior.lon_deg, prior.sigma_m) == pytest.approx((48.2001, 15.1001, 12.0), abs=1e-12)
    for row, true in zip(open_truth(path, frames[0].timestamp_ns), truth, strict=True):
        for name in Truth.__slots__:
            assert getattr(row, name) == pytest.approx(getattr(true, name), abs=1e-9)


@pytest.fixture
def maker():
    return maker_of("ros1")


def test_without_a_compass_the_imu_has_the_heading(tmp_path, maker):
    messages = [(5 * 10**9, maker.imu(10**9 + k, "base_link", 5.0, -7.0, 200.0 + k)) for k in range(3)]
    heading = read_bag(written(tmp_path / "imu.bag", {"/imu/data": messages})).series["heading_deg"]
    assert heading.stamps_ns.tolist() == [10**9 + k for k in range(3)]  # the headers', not the bag's
    assert np.mod(heading.values, 360.0) == pytest.approx([200.0, 201.0, 202.0])


def test_several_topics_with_pictures_ask_for_one(tmp_path, maker):
    topics = {
        f"/{name}/image_raw": [(10**9, maker.image(10**9, "", np.full((4, 6), level, np.uint8)))]
        for name, level in (("front", 10), ("down", 20))
    }
    path = written(tmp_path / "two.bag", topics)
    with pytest.raises(TelemetryError, match=r"one topic.*/down/image_raw, /front/image_raw; .*`image_topic`"):
        BagFrames(path)
    assert (BagFrames(path, "/down/image_raw").read("0") == 20).all()
    assert "pictures on /up" in refusal(BagFrames, path, "/up")


def test_compressed_pictures_and_unset_stamps(tmp_path, maker):
    image = np.random.default_rng(1).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    png = io.BytesIO()
    Image.fromarray(image).save(png, "PNG")
    message = maker.make(
        "sensor_msgs/msg/CompressedImage", header=maker.header(0, ""), format="png",
        data=np.frombuffer(png.getvalue(), np.uint8),
    )  # fmt: skip
    source = BagFrames(written(tmp_path / "png.bag", {"/camera/image_raw/compressed": [(7 * 10**9, message)]}))
    assert source.stamps_ns() == [7 * 10**9]
    assert np.array_equal(source.read("0"), image)


def test_frames_out_of_order_are_refused(tmp_path, maker):
    image = np.zeros((4, 6), np.uint8)
    messages = [(k, maker.image(time_ns, "", image)) for k, time_ns in enumerate((10**9, 3 * 10**9, 2 * 10**9))]
    assert "frame 2 after 3.0" in refusal(BagFrames(written(tmp_path / "x.bag", {IMAGE: messages})).stamps_ns)


def test_a_picture_that_is_published_again_counts_once(tmp_path, maker):
    stamps_ns = [10**9, 10**9, 2 * 10**9, 2 * 10**9, 3 * 10**9]
    pictures = [np.full((4, 6), level, np.uint8) for level in (10, 10, 20, 20, 30)]
    messages = [(k, maker.image(t, "", p)) for k, (t, p) in enumerate(zip(stamps_ns, pictures, strict=True))]
    source = BagFrames(written(tmp_path / "x.bag", {IMAGE: messages}))
    assert source.names == ["0", "2", "4"]
    assert source.stamps_ns() == [10**9, 2 * 10**9, 3 * 10**9]
    for name, level in zip(source.names, (10, 20, 30), strict=True):
        assert np.array_equal(source.read(name), np.full((4, 6, 3), level))  # grey in three channels


def test_the_heading_with_a_stamp_precedes_the_one_without(tmp_path, maker):
    imu = [(k, maker.imu(k, "base_link", 0.0, 0.0, 100.0)) for k in (10**9, 2 * 10**9)]
    compass = [(k, maker.float64(110.0)) for k in (10**9, 2 * 10**9)]
    one = {"/mavros/imu/data": imu, "/mavros/global_position/compass_hdg": compass}
    assert read_bag(written(tmp_path / "one.bag", one)).series["heading_deg"].values == pytest.approx(100.0)
    raw = {"/imu/data": imu, "/mavros/global_position/compass_hdg": compass}
    assert read_bag(written(tmp_path / "raw.bag", raw)).series["heading_deg"].values == pytest.approx(110.0)


def a_bag_with_odometry(path, maker, *, variances=None, without=()):
    """A turn of 60 degrees a second by attitude and odometry, and by a velocity of another source."""
    moments = [(k * STEP_NS, (10.0, -5.0, 20.0 + 6.0 * k), (0.5 * k, -3.0, 0.25)) for k in range(1, 12)]
    topics = {
        IMAGE: [(t, maker.image(t, "", np.zeros((4, 6), np.uint8))) for t, _, _ in moments[::5]],
        "/imu/data": [(t, maker.imu(t, "", *angles)) for t, angles, _ in moments],
        "/uav/velocity_local": [(t, maker.velocity(t, "map", 50.0, 50.0)) for t, _, _ in moments],
        "/vio/odometry": [
            (t + 7, odometry_message(maker, t, angles, enu_mps, yaw_deg=77.0, variances=variances))
            for t, angles, enu_mps in moments
        ],
    }
    return written(path, {name: each for name, each in topics.items() if name not in without})


@pytest.mark.parametrize("variances", [(0.16, 0.04, 0.04), None])
@pytest.mark.parametrize(("ros", "name"), [("ros1", "x.bag"), ("ros2", "x")])
def test_the_velocity_of_another_odometry_is_used_where_it_is_named(tmp_path, ros, name, variances):
    path = a_bag_with_odometry(tmp_path / name, maker_of(ros), variances=variances)
    for item in open_flight(path):
        assert (item.frame.east_velocity_mps, item.frame.velocity_sigma_mps) == (50.0, None)
    for k, item in zip((1, 6, 11), open_flight(path, odometry_topic="/vio/odometry"), strict=True):
        velocity = item.frame.east_velocity_mps, item.frame.north_velocity_mps
        assert velocity == pytest.approx((0.5 * k, -3.0), abs=1e-9)
        turned_mps = np.radians(1.0) * np.linalg.norm((0.5 * k, -3.0, 0.25))
        stated = None if variances is None else pytest.approx(np.hypot(0.4, turned_mps))
        assert item.frame.velocity_sigma_mps == stated


@pytest.mark.parametrize(
    ("options", "topic", "said"),
    [
        ({}, "/odom", "nav_msgs/msg/Odometry on /odom, got /vio/odometry"),
        ({}, "/imu/data", "nav_msgs/msg/Odometry on /imu/data, got /vio/odometry"),
        ({}, "/uav/velocity_local", "nav_msgs/msg/Odometry on /uav/velocity_local, got /vio/odometry"),
        ({"without": ("/imu/data",)}, "/vio/odometry",
         "expected a heading at the times of /vio/odometry, got none"),
        ({"variances": (100.0,) * 3}, "/vio/odometry",
         "expected a velocity that can be used on /vio/odometry, got none"),
    ],
)  # fmt: skip
def test_an_odometry_that_cannot_be_used_is_named(tmp_path, maker, options, topic, said):
    path = a_bag_with_odometry(tmp_path / "x.bag", maker, **options)
    assert said in refusal(read_bag, path, odometry_topic=topic)


def test_a_bag_without_telemetry_or_calibration_says_so(tmp_path, maker):
    path = written(tmp_path / "x.bag", {IMAGE: [(10**9, maker.image(10**9, "", np.zeros((4, 6), np.uint8)))]})
    assert "attitude, height, velocity or position" in refusal(read_bag, path)
    assert "CameraInfo" in refusal(read_bag_camera, path)


def test_what_counts_as_a_bag_and_one_that_is_missing_is_named(tmp_path):
    path, _, _ = a_bag(tmp_path, "ros2-mcap")
    assert is_bag(path)
    assert is_bag(next(path.glob("*.mcap")))
    assert is_bag("FLIGHT.BAG")
    assert not is_bag(tmp_path)
    assert not is_bag("flight.mp4")
    assert len(BagFrames(next(path.glob("*.mcap"))).names) == 5
    assert "no such bag" in refusal(BagFrames, tmp_path / "missing.bag")


# -------------------------------------------------------------------------------------------------- damage


def test_a_folder_whose_description_is_damaged_is_one_line(tmp_path):
    path, _, _ = a_bag(tmp_path, "ros2-mcap", count=2)
    (path / "metadata.yaml").write_bytes(b"rosbag2_bagfile_information: [\n\xff")
    assert str(path) in refusal(open_flight, path)


# ------------------------------------------------------------------------------------------------- of a run


def test_topics_of_the_calibration(tmp_path, maker):
    """The camera_info beside the pictures counts, not the first."""
    topics = {
        IMAGE: [(10**9, maker.image(10**9, "", np.zeros((23, 31), np.uint8)))],
        "/aaa/camera_info": [(10**9, maker.camera_info(10**9, "", Camera.from_fov(31, 23, 30.0)))],
        CAMERA_INFO: [(10**9, maker.camera_info(10**9, "", CAMERA))],
    }
    assert np.array_equal(read_bag_camera(written(tmp_path / "x.bag", topics)).matrix, CAMERA.matrix)


@pytest.mark.parametrize(
    ("name", "compression"),
    [
        ("x.bag", (Writer1.CompressionFormat.BZ2,)),
        ("x.bag", (Writer1.CompressionFormat.LZ4,)),
        ("x", (CompressionMode.MESSAGE, CompressionFormat.ZSTD)),
    ],
)
def test_compressed_bags_are_read(tmp_path, name, compression):
    image = np.random.default_rng(1).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    messages = [(10**9, maker_of("ros1" if name == "x.bag" else "ros2").image(10**9, "", image))]
    path = written(tmp_path / name, {IMAGE: messages}, lambda writer: writer.set_compression(*compression))
    assert np.array_equal(BagFrames(path).read("0"), image)
