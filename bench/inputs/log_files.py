"""Flight logs written byte by byte with known values: what the tests read back and the fuzz damages."""

import struct

from scipy.spatial.transform import Rotation

S = 1_000_000_000
GPS_WEEK, GPS_MS = 2288, 166_418_000  # 2023-11-13 22:13:20 UTC, 18 leap seconds later by GPS
UTC_NS = 1_699_913_600 * S

DATAFLASH = {  # as ArduPilot 4.5 declares them, without fields that nothing here reads
    "ATT": (1, "QccC", "TimeUS,Roll,Pitch,Yaw"),
    "POS": (2, "QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt"),
    "GPS": (3, "QBBIHLLeff", "TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt,Spd,GCrs"),
    "GPA": (4, "QBC", "TimeUS,I,HAcc"),
    "XKF1": (5, "QBff", "TimeUS,C,VN,VE"),
    "RFND": (6, "QBfBB", "TimeUS,Instance,Dist,Stat,Orient"),
    "TERR": (7, "QBf", "TimeUS,Status,CHeight"),
    "CAM": (8, "QH", "TimeUS,Img"),
}
STRUCT = {"Q": "Q", "c": "h", "C": "H", "L": "i", "f": "f", "B": "B", "I": "I", "H": "H", "e": "i"}


def write_dataflash(path, messages):
    """Messages are (name, raw values as they are stored)."""
    data = fmt(0x80, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    for name, (number, types, columns) in DATAFLASH.items():
        layout = "<" + "".join(STRUCT[kind] for kind in types)
        data += fmt(number, 3 + struct.calcsize(layout), name, types, columns)
    for name, *values in messages:
        number, types, _ = DATAFLASH[name]
        layout = "<" + "".join(STRUCT[kind] for kind in types)
        data += bytes((0xA3, 0x95, number)) + struct.pack(layout, *values)
    path.write_bytes(data)
    return path


def fmt(number, length, name, types, columns):
    texts = (name.encode(), types.encode(), columns.encode())
    return bytes((0xA3, 0x95, 0x80)) + struct.pack("<BB4s16s64s", number, length, *texts)


ULOG = {
    "vehicle_attitude": "uint64_t timestamp;uint64_t timestamp_sample;float[4] q;",
    "vehicle_local_position": "uint64_t timestamp;float vx;float vy;float z;float dist_bottom;"
    "bool v_xy_valid;bool z_valid;bool dist_bottom_valid;",
    "vehicle_global_position": "uint64_t timestamp;double lat;double lon;float alt;float eph;",
    "vehicle_gps_position": "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;"
    "float eph;uint8_t fix_type;",
    "distance_sensor": "uint64_t timestamp;float min_distance;float max_distance;float current_distance;"
    "uint8_t orientation;",
    "home_position": "uint64_t timestamp;float alt;",
    "camera_capture": "uint64_t timestamp;uint32_t seq;",
}
ELSE = {
    "vehicle_attitude": "estimator_attitude",
    "vehicle_local_position": "estimator_local_position",
    "vehicle_global_position": "estimator_global_position",
    "vehicle_gps_position": "sensor_gps",
}
ULOG |= {other: ULOG[name] for name, other in ELSE.items()}
ULOG_STRUCT = {
    "vehicle_attitude": "<QQ4f",
    "vehicle_local_position": "<Q4f3?",
    "vehicle_global_position": "<Qddff",
    "vehicle_gps_position": "<QQiiifB",
    "distance_sensor": "<QfffB",
    "home_position": "<Qf",
    "camera_capture": "<QI",
}
ULOG_STRUCT |= {other: ULOG_STRUCT[name] for name, other in ELSE.items()}


def write_ulog(path, messages):
    """As PX4's page on the format has it: header, flags, formats, subscriptions, data."""
    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + ulog_message("B", bytes(40))
    for name, fields in ULOG.items():
        data += ulog_message("F", f"{name}:{fields}".encode())
    numbers = {name: number for number, name in enumerate(ULOG)}
    for name in sorted({name for name, *_ in messages}):
        data += ulog_message("A", struct.pack("<BH", 0, numbers[name]) + name.encode())
    for name, *values in messages:
        data += ulog_message("D", struct.pack("<H", numbers[name]) + struct.pack(ULOG_STRUCT[name], *values))
    path.write_bytes(data)
    return path


def ulog_message(kind, body):
    return struct.pack("<HB", len(body), ord(kind)) + body


def dataflash_flight(path, *, more=(), rangefinder=True):
    """10 s: heading 350 to 10 degrees, north at 8 m/s, climbing from 100 m; the rangefinder to 5 s only."""
    messages = []
    for k in range(11):
        us = 60_000_000 + k * 1_000_000
        messages += [
            ("ATT", us, 1000, -500, (35_000 + 200 * k) % 36_000),
            ("POS", us, 325_000_000 + 1000 * k, 352_500_000, 700.0 + k, 100.0 + k, 0.0),
            ("GPS", us, 0, 3, GPS_MS + 1000 * k, GPS_WEEK, 325_000_100, 352_500_000, 70_000, 8.0, 90.0),
            ("GPS", us, 1, 3, 5, GPS_WEEK, 100_000_000, 100_000_000, 0, 1.0, 0.0),
            ("GPA", us, 0, 150),
            ("XKF1", us, 0, 8.0, -0.5),
            ("XKF1", us, 1, 99.0, 99.0),
            ("TERR", us, 2, 90.0 + k),
        ]
        if rangefinder and k <= 5:
            messages.append(("RFND", us, 0, 50.0, 4, 25))
    return write_dataflash(path, [*messages, *more])


def quaternion(roll_deg, pitch_deg, heading_deg):
    """Of the body in north-east-down, w first."""
    turn = Rotation.from_euler("ZYX", (heading_deg, pitch_deg, roll_deg), degrees=True)
    return turn.as_quat(scalar_first=True)


def ulog_flight(path, *, more=(), without=(), names=None):
    messages = []
    for k in range(5):
        us = 30_000_000 + k * 1_000_000
        messages += [
            ("vehicle_attitude", us + 7_000, us, *quaternion(12.0, -7.0, 350.0 + 10.0 * k)),
            ("vehicle_local_position", us, 3.0, -4.0, -80.0, 60.0, True, True, k < 4),
            ("vehicle_global_position", us, 47.5 + 1e-5 * k, 8.25, 500.0 + k, 0.75),
            ("vehicle_gps_position", us, UTC_NS // 1000 + k * 1_000_000, 475_000_000, 82_500_000, 500_000, 1.0, 3),
            ("distance_sensor", us, 0.1, 40.0, 30.0 if k < 2 else 99.0, 25),
        ]
    messages += [("home_position", 29_000_000, 430.0), *more]
    return write_ulog(
        path, [((names or {}).get(name, name), *values) for name, *values in messages if name not in without]
    )
