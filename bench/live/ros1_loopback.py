"""ROS 1 on loopback: a master, the node, and a publisher that plays a simulated flight; counts and latencies."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

PORT = 11411
LOOPBACK = {"ROS_MASTER_URI": f"http://127.0.0.1:{PORT}", "ROS_IP": "127.0.0.1"}
POSE, DIAGNOSTICS = "/scenematch/pose", "/diagnostics"


def write_world(folder, frames, rate_hz, seed):
    """The flight's folder, and its frames in memory."""
    from scenematch.files.flight import write_flight_folder
    from scenematch.simulator import plan_flight

    plan = plan_flight(seed, frames=frames, rate_hz=rate_hz)
    drawn = list(plan.iter_frames())
    town = plan.town
    write_flight_folder(
        folder,
        frames=[(f"{k:06d}.png", frame) for k, frame in enumerate(drawn[:1])],
        truth=plan.truth_rows(),
        camera=plan.camera,
        ortho_rgb=town.ortho,
        pixel_to_crs=town.pixel_to_crs,
        crs_epsg=town.crs_epsg,
        surface_m=town.surface_m,
    )
    return plan, drawn


@contextlib.contextmanager
def process(*command, **options):
    started = subprocess.Popen(command, env={**os.environ, **LOOPBACK}, **options)
    try:
        yield started
    finally:
        started.terminate()
        started.wait(20)


def wait_until(true, seconds, what):
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            raise SystemExit(f"waited {seconds} s in vain for {what}")
        time.sleep(0.1)


class Listener:
    """Poses and refusals with the moment of their arrival, by the stamp of capture."""

    def __init__(self, rospy):
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseWithCovarianceStamped

        self.poses, self.refusals, self.latencies_ms, self._rospy = {}, {}, [], rospy
        rospy.Subscriber(POSE, PoseWithCovarianceStamped, self.pose, queue_size=1000, tcp_nodelay=True)
        rospy.Subscriber(DIAGNOSTICS, DiagnosticArray, self.diagnostics, queue_size=1000, tcp_nodelay=True)

    def pose(self, message):
        stamp_ns = message.header.stamp.to_nsec()
        self.latencies_ms.append((time.time_ns() - stamp_ns) * 1e-6)
        self.poses[stamp_ns] = message

    def diagnostics(self, message):
        status = message.status[0]
        if status.message.startswith("no fix"):
            self.refusals[message.header.stamp.to_nsec()] = status.message


def play(plan, frames, rate_hz):
    """Publish the flight at its rate, stamped with the moment of publishing; returns when each frame was."""
    import genpy
    import rospy

    from bench.inputs.bags import BagMessages
    from scenematch.bridges.ros import find_class
    from scenematch.files.ros import bags

    rospy.init_node("player", disable_signals=True)
    listener = Listener(rospy)
    kinds = {bags.IMAGE: "sensor_msgs/msg/Image", bags.CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
             bags.IMU: "sensor_msgs/msg/Imu", bags.COMPASS: "std_msgs/msg/Float64",
             bags.HEIGHT: "std_msgs/msg/Float64", bags.VELOCITY: "geometry_msgs/msg/TwistStamped"}  # fmt: skip
    out = {name: rospy.Publisher(name, find_class(kind), queue_size=10, tcp_nodelay=True)
           for name, kind in kinds.items()}  # fmt: skip
    maker = BagMessages(find_class, True, genpy.Time, octets=lambda values: values.tobytes())
    end = time.monotonic() + 120.0
    while not out[bags.IMAGE].get_num_connections():  # the node first asks for the calibration
        if time.monotonic() > end:
            raise SystemExit("waited in vain for the node")
        out[bags.CAMERA_INFO].publish(maker.camera_info(time.time_ns(), "camera", plan.camera))
        time.sleep(0.2)
    time.sleep(1.0)  # the other topics connect
    published, begin = {}, time.monotonic()
    for k, frame in enumerate(frames):
        time.sleep(max(0.0, begin + k / rate_hz - time.monotonic()))
        now_ns = time.time_ns()
        out[bags.IMU].publish(maker.imu(now_ns, "base_link", frame.roll_deg, frame.pitch_deg, frame.heading_deg))
        out[bags.COMPASS].publish(maker.float64(frame.heading_deg))
        out[bags.HEIGHT].publish(maker.float64(frame.height_agl_m))
        out[bags.VELOCITY].publish(
            maker.velocity(now_ns, "map", frame.east_velocity_mps, frame.north_velocity_mps)
        )
        published[now_ns] = k
        out[bags.IMAGE].publish(maker.image(now_ns, "camera", frame.image))
    time.sleep(2.0)
    return listener, published, time.monotonic() - begin - 2.0


def errors_m(plan, listener, published, site):
    truth = plan.truth_rows()
    for stamp_ns, message in listener.poses.items():
        row = truth[published[stamp_ns]]
        east, north = site.frame.enu_from_geodetic(row.lat_deg, row.lon_deg)
        at = message.pose.pose.position
        yield float(np.hypot(at.x - east, at.y - north))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--rate-hz", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--method", default="ncc")
    wanted = parser.parse_args()
    os.environ.update(LOOPBACK)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plan, frames = write_world(folder, wanted.frames, wanted.rate_hz, wanted.seed)
        row = plan.truth_rows()[0]
        node = (sys.executable, "-m", "scenematch.cli", "bridge", "ros", "--ros=1",
                "--map", str(folder / "map.tif"), "--surface", str(folder / "dsm.tif"),
                "--method", wanted.method, "--json",
                "--start", f"{row.lat_deg},{row.lon_deg},15", "--settings=bridge.deadline_ms=250")  # fmt: skip
        with process("rosmaster", "--core", "-p", str(PORT)):
            import rosgraph

            wait_until(rosgraph.is_master_online, 20, "the master")
            with process(*node, stdout=subprocess.PIPE, text=True) as running:
                listener, published, seconds = play(plan, frames, wanted.rate_hz)
                running.send_signal(2)
                told = json.loads(running.communicate(timeout=20)[0])
        from engine.orthomap import OrthoMap

        wrong_m = np.array(list(errors_m(plan, listener, published, OrthoMap.open(folder / "map.tif"))))
    answered = set(listener.poses) | set(listener.refusals)
    at = listener.latencies_ms
    print(json.dumps({
        "published": len(published), "rate_hz": round(len(published) / seconds, 2),
        "poses": len(listener.poses), "refused": len(listener.refusals),
        "without an answer": len(set(published) - answered),
        "latency_ms": {f"p{q}": round(float(np.percentile(at, q)), 1) for q in (50, 95, 99, 100)},
        "error_m": {"rms": round(float(np.sqrt(np.mean(wrong_m**2))), 2), "max": round(float(wrong_m.max()), 2)},
        "node": told,
    }, indent=2))  # fmt: skip


if __name__ == "__main__":
    main()
