"""What steps are thought to cost after the runs that were seen; the clock is the numbers that a test gives."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from engine.budget import Budget, Deadline
from engine.runtime import scheduler, threads
from engine.runtime.device import Device
from engine.runtime.scheduler import OutOfTime, Scheduler
from engine.runtime.step_costs import MAX_WAIT_MS, RUNS, SEVERAL, Costs

ANY_MS = st.floats(1e-3, 1e6)
RUN = st.tuples(st.sampled_from("abc"), ANY_MS, st.floats(0.0, 1.0))  # step, time taken, and the share of it used


def note(costs, step, took_ms, used_share=1.0):
    """A run of a step, which is one stage."""
    costs.learn(step, 1.0, used_share * took_ms, took_ms)
    costs.note_stage(used_share * took_ms, took_ms)


def learned(runs):
    costs = Costs()
    for run in runs:
        note(costs, *run)
    return costs


def can_afford(costs, step, left_ms, *, has_fix=False):
    one = Scheduler(Deadline(Budget(total_ms=left_ms), lambda: 0), Device("cpu"), costs)
    one.has_fix = has_fix
    return one.can_afford({step: 1.0})


@given(st.lists(RUN, max_size=60), st.booleans())
def test_nothing_is_refused_for_its_cost_while_several_times_its_median_is_left(runs, has_fix):
    """Whatever was run before it; beside a fix, while there is time for the longest wait as well."""
    costs = learned(runs)
    for step in "abc":
        last = [took_ms for name, took_ms, _ in runs if name == step][-RUNS:]
        left_ms = SEVERAL * np.percentile(last or [0.0], 50, method="lower") * (1.0 + 1e-9) + has_fix * MAX_WAIT_MS
        assert can_afford(costs, step, left_ms + 1e-9, has_fix=has_fix)


@given(
    st.lists(st.floats(0.8, 1.2), min_size=0, max_size=40),
    st.integers(0, 40),
    ANY_MS,
    st.floats(0.0, 1.0),
    st.sampled_from(["step", "other"]),
    st.booleans(),
)
@example(regular=[], at=0, odd_ms=60_000.0, used_share=1.0, odd_step="step", has_fix=False)  # ran once
def test_no_single_run_however_odd_refuses_a_step(regular, at, odd_ms, used_share, odd_step, has_fix):
    """Of a step that takes 1 ms, give or take a fifth, when there are 2.5 ms."""
    runs = [("step", ms) for ms in regular]
    runs.insert(min(at, len(runs)), (odd_step, odd_ms, used_share))
    assert can_afford(learned(runs), "step", 2.5, has_fix=has_fix)


@pytest.mark.parametrize("factor", [0.1, 0.25, 4.0, 10.0])
def test_a_processor_of_another_pace_is_known_within_ten_frames(factor):
    costs = learned([("step", 2.0)] * 50 + [("step", 2.0 * factor)] * 10)
    assert costs.needed_ms("step", 1.0) == pytest.approx(2.0 * factor, rel=0.01)


@pytest.mark.parametrize("share", [0.5, 0.25, 0.1])
def test_a_processor_that_others_use_is_known_within_ten_frames_also_for_steps_that_do_not_run(share):
    """A frame has five stages; the process runs for a share of the time."""
    costs = learned([("step", 2.0), ("rare", 20.0)] * 50)
    for _ in range(10):
        for stage in "abcde":
            note(costs, stage, 1.0 / share, share)
    assert costs.load() == pytest.approx(1.0 / share, rel=0.1)
    assert costs.needed_ms("rare", 1.0) == pytest.approx(20.0 / share, rel=0.1)


def test_steps_do_not_mix_and_more_work_costs_in_proportion():
    costs = learned([("one", 7.0), ("other", 1.0)] * 5)
    assert costs.needed_ms("one", 1.0) == pytest.approx(7.0)
    assert costs.needed_ms("other", 30.0) == pytest.approx(30.0)


@given(st.lists(RUN, min_size=2, max_size=60), st.floats(1e-3, 1e7), st.booleans())
def test_the_last_resort_of_a_frame_is_hopeless_only_if_no_recent_run_was_quick_enough(runs, left_ms, has_fix):
    """However busy the machine was: a refusal for lack of time gains nothing, unless a fix is at stake."""
    one = Scheduler(Deadline(Budget(total_ms=left_ms), lambda: 0), Device("cpu"), learned(runs))
    one.has_fix = has_fix
    for step in "abc":
        used = [took_ms * share for name, took_ms, share in runs if name == step][-RUNS:]
        assert one.is_hopeless(step, 1.0) == (has_fix or (len(used) > 1 and min(used) > left_ms))


def test_what_is_needed_is_rarely_exceeded():
    rng = np.random.default_rng(0)
    costs, exceeded = Costs(), 0
    for n in range(3000):
        ms = 3.5 * rng.gamma(100, 0.01)  # spread by a tenth
        exceeded += n > 100 and ms > costs.needed_ms("step", 1.0)
        note(costs, "step", ms)
    assert exceeded < 0.03 * 2900
    assert costs.needed_ms("step", 1.0) < 1.6 * 3.5  # and is no mere large number


def test_a_wait_that_comes_again_is_left_time_for_beside_a_fix():
    costs = learned([("step", 2.0)] * 40)
    assert can_afford(costs, "step", 2.1, has_fix=True)
    for _ in range(2):
        note(costs, "step", 6.0, 1 / 3)
    assert costs.wait_ms() == pytest.approx(4.0)
    assert not can_afford(costs, "step", 6.0, has_fix=True)
    assert can_afford(costs, "step", 6.0)


def test_a_refusal_makes_a_step_seem_cheaper_until_it_runs():
    costs = learned([("step", 5.0)] * 9)
    for _ in range(200):
        costs.note_refusal("step", is_idle=False)
    assert costs.needed_ms("step", 1.0) < 2.0
    note(costs, "step", 5.0)  # tried in vain
    assert costs.needed_ms("step", 1.0) == pytest.approx(5.0)
    assert len(costs._runs["step"]) == 10  # it was right, and so were the earlier runs
    for _ in range(100):
        costs.note_refusal("step", is_idle=False)
    note(costs, "step", 1.0)  # and has become cheap
    assert costs.needed_ms("step", 1.0) == pytest.approx(1.0)
    costs.note_refusal("other", is_idle=False)
    assert costs.needed_ms("other", 1.0) == 0.0


def test_a_busy_machine_on_which_nothing_can_be_begun_is_soon_thought_idle():
    costs = learned([("step", 20.0, 0.1)] * 48)
    assert costs.load() == pytest.approx(10.0, rel=0.05)
    for _ in range(24):
        Scheduler(Deadline(Budget()), Device("cpu"), costs).note_refusal("step")
        note(costs, "grey", 0.3)  # what each frame does
    assert costs.load() < 1.01


def test_the_load_is_remembered_while_steps_run_although_others_are_refused(monkeypatch):
    costs = learned([("step", 20.0, 0.1)] * 48)
    clock, one = clocked(1e3, costs, monkeypatch)
    with one.costed("step", 1.0), one.stage("match"):
        clock["ms"] += 20.0
    before = costs.load(), costs.wait_ms()
    for name in ("refinement", "sift", "few"):
        one.note_refusal(name)
    assert (costs.load(), costs.wait_ms()) == before


def clocked(budget_ms, costs, monkeypatch):
    """A scheduler on a clock that the test turns."""
    clock = {"ms": 0.0}
    monkeypatch.setattr(scheduler.time, "thread_time_ns", lambda: round(clock["ms"] * 1e6))
    deadline = Deadline(Budget(total_ms=budget_ms), lambda: round(clock["ms"] * 1e6))
    return clock, Scheduler(deadline, Device("cpu"), costs)


def abandoned(one, clock, *, after_each_ms=0.0, **stages_ms):
    """The stage before which a step was abandoned, None if it was not; some time is in no stage."""
    try:
        with one.costed("step", 1.0):
            for name, ms in stages_ms.items():
                with one.stage(name):
                    clock["ms"] += ms
                clock["ms"] += after_each_ms
    except OutOfTime:
        return name
    return None


def test_what_is_abandoned_costs_more_than_the_time_that_it_had(monkeypatch):
    costs = Costs()
    for _ in range(RUNS):
        clock, one = clocked(10.0, costs, monkeypatch)
        assert abandoned(one, clock, first=12.0, second=1.0) == "second"
    assert costs.needed_ms("step", 1.0) == pytest.approx(10.0)


@pytest.mark.parametrize("after_each_ms", [0.0, 0.5, 4.0])
def test_beside_a_fix_a_step_is_abandoned_as_soon_as_its_rest_would_lose_it(monkeypatch, after_each_ms):
    """Its rest is all that follows, whether it belongs to a stage or not."""
    costs = Costs()
    for _ in range(3):
        clock, one = clocked(100.0, costs, monkeypatch)
        assert abandoned(one, clock, match=4.0, vote=0.5, pose=5.0, after_each_ms=after_each_ms) is None
    clock, one = clocked(10.0 + 3.0 * after_each_ms, costs, monkeypatch)
    with one.with_fix():  # the first takes longer than usual
        assert abandoned(one, clock, match=6.0, vote=0.5, pose=5.0, after_each_ms=after_each_ms) == "vote"
    assert one.deadline.met


def test_beside_a_fix_there_must_be_time_for_the_answer_too(monkeypatch):
    costs = learned([("step", 4.0)] * 3)
    for _ in range(3):
        clock, one = clocked(100.0, costs, monkeypatch)
        assert abandoned(one, clock, match=4.0) is None
        clock["ms"] += 2.0  # what the methods do with it
        one.note_answer()
    assert can_afford(costs, "step", 6.0, has_fix=True)
    assert not can_afford(costs, "step", 5.9, has_fix=True)
    assert can_afford(costs, "step", 4.0)


@pytest.mark.parametrize(("count", "used_ms"), [(1, 1.0), (2, 9.0)])
def test_only_if_one_thread_works_its_waiting_is_told_apart(count, used_ms, monkeypatch):
    """A thread that lets others work is off the processor for as long as they work."""
    monkeypatch.setattr(threads, "count", lambda: count)
    clock_ns, processor_ns = iter([0, 0, 0, *[9_000_000] * 2]), iter([0, *[1_000_000] * 2])
    monkeypatch.setattr(scheduler.time, "thread_time_ns", lambda: next(processor_ns))
    learned, costs = [], Costs()
    monkeypatch.setattr(costs, "learn", lambda *run: learned.append(run))
    one = Scheduler(Deadline(Budget(), lambda: next(clock_ns)), Device("cpu"), costs)
    with one.costed("step", 5.0):
        pass
    assert learned == [("step", 5.0, pytest.approx(used_ms), pytest.approx(9.0))]
