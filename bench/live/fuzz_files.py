"""Fuzz of what lies on disk: mutated logs, bags, tables and routes into their readers; each is read or refused."""

from __future__ import annotations

import json
import random
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.inputs.bags import BAG_KINDS, write_bag
from bench.inputs.log_files import S, dataflash_flight, ulog_flight
from engine.camera import Camera
from engine.errors import EngineError
from engine.values import Frame, Prior
from scenematch.files.export import WRITERS
from scenematch.files.flight import _frame, open_flight
from scenematch.files.logs.readers import open_log
from scenematch.files.resampling import UTC_FROM_NS, rows_and_sources_at, truth_from_log
from scenematch.files.ros.bags import read_bag_camera
from scenematch.files.route import read_route
from scenematch.files.telemetry import TelemetryRow, ground_amsl_m, read_telemetry, write_telemetry
from scenematch.files.track import read_track
from scenematch.files.truth import interpolate_truth, read_truth

LIMIT_S = 2.0
"""Of the processor; a file that takes longer is a hang."""
IMAGE = np.zeros((2, 2), np.uint8)


class Hang(BaseException):
    """Raised by the clock; no reader's ``except Exception`` can take it for damage."""


@dataclass
class Fuzzed:
    """What became of the files, by kind: ``read`` or ``refused``."""

    outcomes: dict[str, Counter[str]] = field(default_factory=dict)
    longest_s: float = 0.0


# ----------------------------------------------------------------------------------- what is done with a file


def use_log(path: Path) -> None:
    """Everything that ``track`` asks of a log."""
    log = open_log(path)
    begin, end = log.span_ns
    moments = sorted({begin, (begin + end) // 2, end})
    with suppress(EngineError):
        rows, _ = rows_and_sources_at(log, moments, [str(i) for i in range(len(moments))])
        use_rows(rows)
    for utc in (False, True):
        with suppress(EngineError):
            truth_from_log(log, utc=utc)
    with suppress(EngineError):
        log.clock_shift_ns(UTC_FROM_NS)


def use_bag(path: Path) -> None:
    """Every picture of a bag, which of ROS 2 is the folder about a file, and its camera."""
    bag = path if path.suffix == ".bag" else path.parent
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # rosbags' own, where a file breaks while it opens
        for item in open_flight(bag):
            assert item.frame.image.dtype == np.uint8
        read_bag_camera(bag)


def use_rows(rows: list[TelemetryRow]) -> None:
    """What a flight makes of its telemetry: frames and priors, which refuse what cannot be."""
    for row in rows:
        _frame(IMAGE, row)
        _ = row.prior
    ground_amsl_m(rows)


def use_telemetry(path: Path) -> None:
    use_rows(read_telemetry(path))


def use_truth(path: Path) -> None:
    rows = read_truth(path)
    interpolate_truth(rows, (rows[0].timestamp_ns + rows[-1].timestamp_ns) // 2)


def use_track(path: Path) -> None:
    rows = read_track(path)
    for write in WRITERS.values():
        with suppress(EngineError):
            write(rows)


# ----------------------------------------------------------------------------------------------------- seeds

SRT = """1
00:00:00,000 --> 00:00:00,033
<font size="28">FrameCnt: 1, DiffTime: 33ms
2023-11-14 22:13:20.123
[iso: 100] [latitude: 32.501] [longitude: -35.250000] [rel_alt: 81.500 abs_alt: 712.300] \
[gb_yaw: -10.0 gb_pitch: -90.0 gb_roll: 0.0] </font>

2
00:00:01,000 --> 00:00:01,500
HOME(-35.2500,32.5000) 2017.05.06 12:13:11
GPS(-35.2500,32.502,17) BAROMETER:82.5
F/2.8, SS 206.14, GPS (-35.2500, 32.503, 17), D 24.35m, H 83.5m, H.S 0.00m/s
"""
TRUTH = """timestamp_ns,lat_deg,lon_deg,alt_amsl_m,height_agl_m,roll_deg,pitch_deg,heading_deg
1000000000,32.5,35.25,700.0,100.0,1.0,-2.0,359.0
2000000000,32.50001,35.25001,701.0,101.0,1.5,-2.5,1.0
"""
TRACK = """timestamp_ns,frame,status,reason,lat_deg,lon_deg,east_m,north_m,up_m,sigma_east_m,sigma_north_m,\
covariance_en_m2,score,method,window_width_px,window_height_px,latency_ms,deadline_met
1700000000000000000,a.png,fix,,32.5,35.25,1.0,2.0,3.0,0.5,0.5,0.01,0.9,ncc,200,200,20.1,true
1700000000200000000,b.png,no_fix,no_texture,,,,,,,,,0.1,ncc,200,200,20.1,true
"""
TRANSECT = {"Items": [{"command": 16, "params": [0, 0, 0, None, 33.65, 72.98, 50]}]}
PLAN = {
    "fileType": "Plan",
    "mission": {
        "plannedHomePosition": [33.64, 72.99, 500],
        "items": [
            {"command": 22, "type": "SimpleItem", "params": [15, 0, 0, None, 33.64, 72.99, 50]},
            {"TransectStyleComplexItem": TRANSECT},
            {"command": 20, "type": "SimpleItem", "params": [0, 0, 0, 0, 0, 0, 0]},
        ],
    },
}
LINE = {"type": "LineString", "coordinates": [[72.99, 33.64], [72.991, 33.641], [72.992, 33.64, 90.0]]}
GEOJSON = {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": LINE}]}


def seeds(folder: Path) -> dict[str, tuple[str, bytes, Callable[[Path], object]]]:
    """Of each kind: a file's name, a sound file, and what is done with one."""
    row = TelemetryRow(
        timestamp_ns=S, frame="a.png", height_agl_m=100.0, alt_amsl_m=600.0, heading_deg=359.0, roll_deg=1.0,
        pitch_deg=-2.0, east_velocity_mps=3.0, north_velocity_mps=-4.0, lat_deg=32.5, lon_deg=35.25, sigma_m=5.0,
    )  # fmt: skip
    write_telemetry(folder / "seed.csv", [row, replace(row, timestamp_ns=2 * S, frame="b.png")])
    return {
        "DataFlash": ("a.BIN", dataflash_flight(folder / "seed.BIN").read_bytes(), use_log),
        "ULog": ("a.ulg", ulog_flight(folder / "seed.ulg").read_bytes(), use_log),
        "SRT": ("a.srt", SRT.encode(), use_log),
        "telemetry.csv": ("telemetry.csv", (folder / "seed.csv").read_bytes(), use_telemetry),
        "truth.csv": ("truth.csv", TRUTH.encode(), use_truth),
        "track.csv": ("track.csv", TRACK.encode(), use_track),
        "plan": ("a.plan", json.dumps(PLAN, indent=1).encode(), read_route),
        "GeoJSON": ("a.geojson", json.dumps(GEOJSON, indent=1).encode(), read_route),
        **{f"bag, {kind}": seed_bag(folder, kind) for kind in BAG_KINDS},
    }


def seed_bag(folder: Path, kind: str) -> tuple[str, bytes, Callable[[Path], object]]:
    """The file of a bag that holds its messages; a folder's other file, the metadata, stays sound."""
    rng, start = np.random.default_rng(1), Prior(lat_deg=48.0, lon_deg=15.0, sigma_m=10.0)
    pictures = rng.integers(0, 256, (3, 6, 8, 3), dtype=np.uint8)
    frames = [Frame(one, S + k * S // 10, 100.0, 10.0, 1.0, 2.0, 3.0, 4.0) for k, one in enumerate(pictures)]
    path = folder / ("seed.bag" if kind == "ros1" else kind)
    write_bag(path, ((frame, start) for frame in frames), Camera.from_fov(8, 6, 60.0), kind=kind)
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix != ".yaml")
    return str(file.relative_to(folder)), file.read_bytes(), use_bag


# --------------------------------------------------------------------------------------------------- mutations

_WORDS = [
    bytes.fromhex(text)
    for text in ("00000000", "ffffffff", "7fffffff", "80000000", "0000c07f", "010080ff", "a39580")
]
_CELLS = (
    "", "nan", "-inf", "1e999", "-0", "9" * 400, "1e308", "-1e308", "0x10", "1_000", "９", "\x00", "\ufeff", '"',
    ",", "\n", "\r", "[", "{", "null", "true", str(2**63), str(-(2**63)), str(2**63 - 1), "1e-320", "-->",
)  # fmt: skip

_STRANGE: tuple[Any, ...] = (
    None, True, -1, 10**400, 1e308, float("nan"), "", "LineString", [], {}, [[]], {"type": "Feature"}, [1],
    [1, 2, 3],
)  # fmt: skip


def damaged(rng: random.Random, data: bytes) -> bytes:
    """Bytes turned, cut, repeated, moved, or put in."""
    data = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4, 16))):
        at = rng.randrange(len(data) + 1)
        length = rng.choice((1, 2, 4, 8, 40, 300))
        piece = bytes(data[at : at + length])
        choice = rng.randrange(7)
        if choice == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif choice == 1:
            word = rng.choice(_WORDS)
            data[at : at + len(word)] = word
        elif choice == 2:
            data[at:at] = rng.randbytes(rng.randrange(1, 40))
        elif choice == 3:
            del data[at : at + length]
        elif choice == 4:
            data[at:at] = piece * rng.choice((1, 2, 50))
        elif choice == 5:
            data[(other := rng.randrange(len(data) + 1)) : other] = piece
        elif rng.random() < 0.3:
            del data[at:]
    return bytes(data)


def garbled(rng: random.Random, data: bytes) -> bytes:
    """Text of which a number, a word or a line was replaced."""
    text = data.decode("utf-8")
    for _ in range(rng.choice((1, 1, 2, 5))):
        marks = [i for i, c in enumerate(text) if c in ',\n :[]()"'] or [0]
        begin = rng.choice(marks)
        end = next((i for i in marks if i > begin), len(text))
        text = text[: begin + 1] + rng.choice(_CELLS) + text[end:]
    return text.encode("utf-8", "replace")


def rebuilt(rng: random.Random, data: bytes) -> bytes:
    """JSON of which one value is another, of any kind and depth."""
    content = json.loads(data)
    if rng.random() < 0.1:
        return (b"[" * 100_000) if rng.random() < 0.5 else b'{"type":"Feature","geometry":' * 5000
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        keys = node.keys() if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        for key in keys:
            places.append((node, key))
            walk(node[key])

    walk(content)
    node, key = rng.choice(places)
    node[key] = rng.choice(_STRANGE)
    return json.dumps(content).encode()


def mutated(rng: random.Random, name: str, data: bytes) -> bytes:
    """A damaged file of a kind."""
    makers = [damaged]
    if not name.endswith((".BIN", ".ulg", ".bag", ".db3", ".mcap")):
        makers.append(garbled)
    if name.endswith((".plan", ".geojson")):
        makers.append(rebuilt)
    return rng.choice(makers)(rng, data)


# -------------------------------------------------------------------------------------------------------- run


def fuzz(count: int, seed: int, kinds: tuple[str, ...] = ()) -> Fuzzed:
    """So many files of each kind; whatever is neither read nor refused in one line and in time is raised."""
    result, rng = Fuzzed(), random.Random(seed)
    before = signal.signal(signal.SIGPROF, _ring)
    with tempfile.TemporaryDirectory() as text, warnings.catch_warnings():
        warnings.simplefilter("error")
        folder = Path(text)
        try:
            for kind, (name, data, use) in seeds(folder).items():
                if kinds and kind not in kinds:
                    continue
                outcomes = result.outcomes.setdefault(kind, Counter())
                for number in range(count):
                    (folder / name).write_bytes(mutated(rng, name, data) if number else data)
                    outcome, spent_s = _tried(use, folder / name)
                    outcomes[outcome] += 1
                    result.longest_s = max(result.longest_s, spent_s)
                    if number == 0 and outcome != "read":
                        raise AssertionError(f"{kind}: the sound file was refused")
        finally:
            signal.signal(signal.SIGPROF, before)
    return result


def _tried(use: Callable[[Path], object], path: Path) -> tuple[str, float]:
    begin = time.perf_counter()
    signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
    outcome = "read"
    try:
        use(path)
    except EngineError as error:
        if "\n" in str(error):
            raise AssertionError(f"a refusal of more than one line: {error}") from error
        outcome = "refused"
    except BaseException as error:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        kept = Path(tempfile.gettempdir()) / f"fuzz-{path.name}"
        kept.write_bytes(path.read_bytes())
        error.add_note(f"the file is kept as {kept}")
        raise
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    return outcome, time.perf_counter() - begin


def _ring(*_: object) -> None:
    raise Hang(f"no answer after {LIMIT_S:g} s of the processor")


if __name__ == "__main__":
    start = time.perf_counter()
    done = fuzz(int(sys.argv[1]) if len(sys.argv) > 1 else 5000, seed=1, kinds=tuple(sys.argv[2:]))
    for each, told in done.outcomes.items():
        print(f"{each}: {sum(told.values()):,} files, {told['read']:,} read, {told['refused']:,} refused")
    print(f"longest {done.longest_s * 1e3:.0f} ms, {time.perf_counter() - start:.0f} s in all")
