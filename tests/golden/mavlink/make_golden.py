"""Makes the golden packets of tests/bridges/test_mavlink.py by pymavlink alone, every field spelled out.

One fix: 33.641 N 72.992 E, sigma 0.5 m east and 0.4 m north, captured at 12.345678 s, sent 80 ms later, by a
vehicle 120 m above an origin at 33.640 N 72.990 E, rolled by 2, pitched by -3 and headed for 270 degrees.
"""

import math
import sys
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.quaternion import Quaternion
from pymavlink.rotmat import Matrix3, Vector3

OUT = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
NAN = math.nan
ROLL, PITCH, YAW = math.radians(2.0), math.radians(-3.0), math.radians(-90.0)
LAT, LON, LAT0, LON0 = 33.641, 72.992, 33.640, 72.990

# ArduPilot's Location: metres per 1e-7 degrees, the longitude's by the cosine of the middle latitude.
SCALE = 0.011131884502145034
ARDUPILOT = ((LAT - LAT0) * 1e7 * SCALE, (LON - LON0) * 1e7 * SCALE * math.cos(math.radians((LAT + LAT0) / 2)))

# PX4's MapProjection: azimuthal equidistant on a sphere of 6,371 km.
la, la0, turn = math.radians(LAT), math.radians(LAT0), math.radians(LON - LON0)
c = math.acos(math.sin(la0) * math.sin(la) + math.cos(la0) * math.cos(la) * math.cos(turn))
k = c / math.sin(c) * 6371000.0
PX4 = (
    k * (math.cos(la0) * math.sin(la) - math.sin(la0) * math.cos(la) * math.cos(turn)),
    k * math.cos(la) * math.sin(turn),
)

POSE = [0.0] * 21
POSE[0], POSE[6], POSE[11] = 0.4**2, 0.5**2, 0.5**2
POSE[15] = POSE[18] = POSE[20] = math.radians(10.0) ** 2
SPEED = [0.0] * 21
SPEED[0] = SPEED[6] = SPEED[11] = 0.7**2
Q = list(Quaternion([ROLL, PITCH, YAW]).q)

turned = Matrix3()
turned.from_euler(ROLL, PITCH, YAW)
body = turned.transposed() * Vector3(-2.5, 1.5, -0.5)  # north, east, down

week_ms = 1_700_000_000_123 - 315_964_800_000 + 18_000


def odometry(frame, place):
    return mavlink.MAVLink_odometry_message(
        time_usec=12345678, frame_id=frame, child_frame_id=mavlink.MAV_FRAME_BODY_FRD,
        x=place[0], y=place[1], z=-120.0, q=Q, vx=body.x, vy=body.y, vz=body.z,
        rollspeed=NAN, pitchspeed=NAN, yawspeed=NAN, pose_covariance=POSE, velocity_covariance=SPEED,
        reset_counter=3, estimator_type=mavlink.MAV_ESTIMATOR_TYPE_VISION, quality=0,
    )  # fmt: skip


PACKETS = {
    "ardupilot-vision_position_estimate": mavlink.MAVLink_vision_position_estimate_message(
        usec=12345678, x=ARDUPILOT[0], y=ARDUPILOT[1], z=-120.0, roll=ROLL, pitch=PITCH, yaw=YAW,
        covariance=POSE, reset_counter=3,
    ),
    "ardupilot-odometry": odometry(mavlink.MAV_FRAME_LOCAL_FRD, ARDUPILOT),
    "px4-odometry": odometry(mavlink.MAV_FRAME_LOCAL_NED, PX4),
    "ardupilot-gps_input": mavlink.MAVLink_gps_input_message(
        time_usec=12345678, gps_id=0, ignore_flags=0, time_week_ms=week_ms % 604_800_000,
        time_week=week_ms // 604_800_000, fix_type=3, lat=336410000, lon=729920000, alt=630.0, hdop=0.5, vdop=0.5,
        vn=-2.5, ve=1.5, vd=-0.5, speed_accuracy=0.7, horiz_accuracy=0.5, vert_accuracy=0.5,
        satellites_visible=20, yaw=0,
    ),
    "px4-global_position_sensor": mavlink.MAVLink_global_position_sensor_message(
        target_system=0, target_component=0, id=1, time_usec=12345678 + 80000, processing_time=80000,
        source=mavlink.GLOBAL_POSITION_SRC_VISION, flags=0, lat=336410000, lon=729920000, alt_ellipsoid=NAN,
        alt=NAN, eph=0.5, epv=NAN,
    ),
    "heartbeat": mavlink.MAVLink_heartbeat_message(
        type=mavlink.MAV_TYPE_ONBOARD_CONTROLLER, autopilot=mavlink.MAV_AUTOPILOT_INVALID, base_mode=0,
        custom_mode=0, system_status=mavlink.MAV_STATE_ACTIVE, mavlink_version=3,
    ),
    "timesync-question": mavlink.MAVLink_timesync_message(tc1=0, ts1=12_345_678_901),
    "timesync-answer": mavlink.MAVLink_timesync_message(tc1=12_345_678_901, ts1=5_000_000_007),
    "set_gps_global_origin": mavlink.MAVLink_set_gps_global_origin_message(
        target_system=1, latitude=336400000, longitude=729900000, altitude=510000, time_usec=12345678,
    ),
    "ask-origin": mavlink.MAVLink_command_long_message(
        target_system=1, target_component=1, command=mavlink.MAV_CMD_REQUEST_MESSAGE, confirmation=0,
        param1=49.0, param2=0.0, param3=0.0, param4=0.0, param5=0.0, param6=0.0, param7=0.0,
    ),
    "ask-attitude": mavlink.MAVLink_command_long_message(
        target_system=1, target_component=1, command=mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, confirmation=0,
        param1=30.0, param2=20000.0, param3=0.0, param4=0.0, param5=0.0, param6=0.0, param7=0.0,
    ),
}  # fmt: skip

for name, message in PACKETS.items():
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
    (OUT / f"{name}.hex").write_text(message.pack(sender).hex() + "\n", encoding="ascii")

# The same fix, signed 10 years after signatures began to count.
signer = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
signer.signing.secret_key, signer.signing.sign_outgoing = bytes(range(32)), True
signer.signing.timestamp = 10 * 365 * 86400 * 100_000
signed = PACKETS["ardupilot-vision_position_estimate"].pack(signer)
(OUT / "ardupilot-signed.hex").write_text(signed.hex() + "\n", encoding="ascii")
