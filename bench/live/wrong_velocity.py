"""A velocity in the telemetry that is wrong: what the navigator answers, and what the guard lets through.

    python -m bench.live.wrong_velocity [--frames N] [--docs DIR]

Frames of the two recorded Gazebo flights by NCC, each matched by the navigator and held against the track guard,
as in the MAVLink bridge. Writes the table into docs/results/mavlink.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bench.accuracy.flights import Recorded, recorded
from bench.accuracy.truth import true_start
from bench.command import parser_on_one_thread
from bench.pages.text import fill, table
from engine import Fix, Frame, Navigator, SceneMatcher
from engine.navigation.motion import position_of
from scenematch.bridges.track_guard import TrackGuard

FLIGHTS = ("gazebo-a1", "gazebo-a2")
SHIFT_M = 40.0


@dataclass(frozen=True)
class Case:
    """How many m/s the velocity is off at a time, when nothing is seen, and when the map is shifted."""

    name: str
    off_mps: Callable[[float], float]
    dark_s: tuple[float, float] = (0.0, 0.0)
    shifted_s: tuple[float, float] = (np.inf, np.inf)


CASES = [
    *(Case(f"{off:g} m/s", lambda _, off=off: off) for off in (0.0, 2.0, 3.0, 4.3, 8.0)),  # type: ignore[misc]
    *(Case(f"{off:g} m/s from 10 s on", lambda t, off=off: off * (t > 10.0)) for off in (4.3, 8.0)),  # type: ignore[misc]
    Case("4.3 m/s from an outage of 10 s on", lambda t: 4.3 * (t > 10.0), (10.0, 20.0)),
    Case("growing to 4.3 m/s in an outage of 10 s, right 3 s after it",
         lambda t: float(np.interp(t, (10.0, 20.0), (0.0, 4.3))) * (t < 23.0), (10.0, 20.0)),
    Case("3 m/s from an outage of 20 s on", lambda t: 3.0 * (t > 10.0), (10.0, 30.0)),
    Case("0, map 40 m off from 20 s on", lambda _: 0.0, shifted_s=(20.0, np.inf)),
    Case("growing by 0.2 m/s2 while the map is 40 m off for 20 s",
         lambda t: 0.2 * float(np.clip(t - 20.0, 0.0, 20.0)), shifted_s=(20.0, 40.0)),
    Case("4.3 m/s, map 40 m off from 20 s on", lambda _: 4.3, shifted_s=(20.0, np.inf)),
]  # fmt: skip


@dataclass
class Answers:
    """How many frames were fixed and sent, how many of these on the shifted map, and the largest error, m."""

    fixed: int = 0
    sent: int = 0
    shifted: int = 0
    worst_m: float = 0.0


def fly(flight: Recorded, matcher: SceneMatcher, case: Case) -> Answers:
    """Follow the flight from its true start."""
    start, out = true_start(flight.truth), Answers()
    navigator, guard = Navigator(matcher, start), TrackGuard(position_of(start, flight.site))
    begin_ns = flight.frames[0][0].timestamp_ns or 0
    for frame, _ in flight.frames:
        stamp_ns = frame.timestamp_ns or 0
        time_s = (stamp_ns - begin_ns) * 1e-9
        shown = _changed(frame, case, time_s)
        guard.advance(shown, stamp_ns)
        result, true_m = navigator.update(shown), flight.true_place_m(stamp_ns)
        is_shifted = case.shifted_s[0] < time_s <= case.shifted_s[1]
        if isinstance(result, Fix) and is_shifted:  # as the shifted map states it
            result = replace(result, east_m=result.east_m + SHIFT_M)
        if isinstance(result, Fix) and guard.trusts(result):
            out.sent += 1
            out.shifted += is_shifted
        if isinstance(result, Fix) and true_m is not None:
            out.fixed += 1
            off_m = float(np.hypot(result.east_m - true_m[0], result.north_m - true_m[1]))
            out.worst_m = max(out.worst_m, 0.0 if is_shifted else off_m)
    return out


def _changed(frame: Frame, case: Case, time_s: float) -> Frame:
    """The frame with the wrong velocity, and without its picture while nothing is seen."""
    east_mps, (begin_s, end_s) = frame.east_velocity_mps, case.dark_s
    image = np.zeros_like(np.asarray(frame.image)) if begin_s <= time_s < end_s else frame.image
    return replace(
        frame, image=image, east_velocity_mps=None if east_mps is None else east_mps + case.off_mps(time_s)
    )


def main() -> None:
    """Fly every case, and fill the page's table."""
    parser = parser_on_one_thread(__doc__, docs=True)
    parser.add_argument("--frames", type=int, default=300, help="of each flight")
    options = parser.parse_args()
    flights = [recorded(name, 1) for name in FLIGHTS]
    flights = [replace(flight, frames=flight.frames[: options.frames]) for flight in flights]
    matchers = [SceneMatcher(flight.site, flight.camera, "ncc", "cpu") for flight in flights]
    rows = []
    for case in CASES:
        both = [fly(flight, matcher, case) for flight, matcher in zip(flights, matchers, strict=True)]
        is_never = np.isinf(case.shifted_s[0])
        of_these = "" if is_never else ", shifted ones " + ", ".join(str(b.shifted) for b in both)
        fixed, sent = (", ".join(str(getattr(b, what)) for b in both) for what in ("fixed", "sent"))
        rows.append([case.name, fixed, sent + of_these, f"{max(b.worst_m for b in both):.2f} m"])
        print(" | ".join(rows[-1]), flush=True)
    titles = ["velocity off by", "answered by the navigator", "sent", "largest error on the true map"]
    fill(options.docs / "mavlink.md", {"velocity": table(titles, rows)})


if __name__ == "__main__":
    main()
