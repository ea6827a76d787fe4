"""What the latency benchmark counts with: the way forth and back, causes of misses, slopes, shares, and hogs."""

from collections import Counter
from functools import partial

import numpy as np
import pytest

from bench.live import endless
from bench.live.burden import hogs
from bench.live.endless import Flown, Taken, cause, draw, stage_at, summary
from bench.live.growth import slope
from bench.pages.latency import share
from scenematch.simulator import plan_flight
from tests.support.towns import drawn_town

STAGES = {"grey": 1.0, "align": 2.0, "match": 4.0}


def flown(wall_ms, error_m, error_sigmas, budget_ms=5.0):
    wall = np.array(wall_ms, float)
    errors = np.array(error_m, float), np.array(error_sigmas, float)
    return Flown(budget_ms, wall, 0.5 * wall, *errors, Counter(), Counter(), 0, 1, Counter())


def test_an_endless_course_moves_as_its_velocities_say_also_on_the_way_back(monkeypatch):
    monkeypatch.setattr(endless, "plan_flight", partial(plan_flight, town=drawn_town()))
    course = draw(4)
    frames = [course.frame(number) for number in range(7)]
    assert (np.diff([frame.timestamp_ns for frame in frames]) == course.step_ns).all()
    there, back = frames[2], frames[4]
    assert there.image is back.image
    assert there.east_velocity_mps == -back.east_velocity_mps
    assert there.north_velocity_mps == -back.north_velocity_mps


def test_the_stage_at_a_moment():
    found = [stage_at(STAGES, ms) for ms in (0.5, 1.0, 2.9, 3.0, 6.9)]
    assert found == ["grey", "align", "align", "match", "match"]
    assert stage_at(STAGES, 7.0) == stage_at({}, 0.0) == "none"


@pytest.mark.parametrize(
    ("taken", "why"),
    [
        (Taken(20.0, 6.0, 0.0, 2), "preempted"),  # without the lost core it would have been on time
        (Taken(20.0, 6.0, 0.0, 0), "held or waiting"),
        (Taken(12.0, 12.0, 3.0, 1), "garbage collector"),
        (Taken(12.0, 12.0, 1.0, 1), "stage match"),
    ],
)
def test_a_miss_is_put_down_to_what_alone_made_it_one(taken, why):
    assert cause(taken, STAGES, budget_ms=5.0, allowed_ms=10.0) == why


def test_shares_are_of_all_frames_and_only_false_fixes_are_wrong():
    nan = float("nan")
    row = summary(flown([1.0, 10.0, 10.1, 50.0], [3.0, 12.0, 12.0, nan], [9.0, 2.9, 3.1, nan]), "x", stop_ms=1.0)
    assert row["within"] == 0.5  # 5 ms and the grace of 5 ms
    assert row["within_but_a_stop"] == row["within_on_core"] == 0.75
    assert (row["availability"], row["wrong"]) == (0.75, 1)
    assert row["rms_m"] == pytest.approx(np.sqrt((9 + 144 + 144) / 3))


def test_a_flight_without_a_fix_has_no_error():
    row = summary(flown([1.0, 2.0], [np.nan] * 2, [np.nan] * 2), "x")
    assert (row["rms_m"], row["availability"], row["wrong"]) == (None, 0.0, 0)


def test_the_slope_leaves_out_the_first_tenth():
    values = np.concatenate([np.full(10, 500.0), 3.0 * np.arange(90)])
    assert slope(50.0 * np.arange(100), values) == pytest.approx(3.0 / 50)
    assert slope(np.zeros(1), np.ones(1)) == 0.0


def test_a_share_is_full_only_where_nothing_is_missing():
    assert share(1.0) == "100 %"
    assert share(1.0 - 1e-9) == "99.99 %"
    assert share(None) == "-"


def test_hogs_burn_until_their_block_ends():
    with hogs(2) as burning:
        assert [process.poll() for process in burning] == [None, None]
    assert all(process.poll() is not None for process in burning)
