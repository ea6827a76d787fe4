"""The cost model: what it expects after the costs that it has seen."""

from __future__ import annotations

from itertools import cycle

import numpy as np
import pytest

from engine.methods.costs import Costs


def learned(works, cost, step="step"):
    costs = Costs()
    for work in works:
        costs.learn(step, work, cost(work))
    return costs


def test_what_never_ran_costs_nothing_yet():
    assert Costs().upper_bound_ms("step", 1e9) == 0.0


def test_a_line_is_learned():
    costs = learned([100, 400, 200, 300] * 40, lambda work: 2.0 + 0.01 * work)
    for work in (50, 250, 1000):
        assert costs.upper_bound_ms("step", work) == pytest.approx(2.0 + 0.01 * work, rel=0.05)


def test_steps_do_not_mix():
    costs = learned([1.0] * 5, lambda work: 7.0, "one")
    costs.learn("other", 1.0, 1.0)
    assert costs.upper_bound_ms("one", 1.0) == pytest.approx(7.0)
    assert costs.upper_bound_ms("other", 1.0) == pytest.approx(1.0)


def test_more_of_what_was_always_alike_costs_in_proportion():
    costs = learned([100.0] * 10, lambda work: 4.0)
    assert costs.upper_bound_ms("step", 300.0) == pytest.approx(12.0)
    assert costs.upper_bound_ms("step", 10.0) == pytest.approx(4.0)


def test_the_upper_bound_is_rarely_exceeded():
    rng = np.random.default_rng(0)
    costs, exceeded = Costs(), 0
    for n in range(3000):
        work = rng.uniform(100, 400)
        ms = (1.0 + 0.01 * work) * rng.gamma(100, 0.01)  # spread by a tenth
        exceeded += n > 100 and ms > costs.upper_bound_ms("step", work)
        costs.learn("step", work, ms)
    assert exceeded < 0.02 * 2900
    assert costs.upper_bound_ms("step", 250.0) < 1.6 * 3.5  # and is no mere large number


def test_one_interruption_changes_little():
    costs = learned([1.0] * 50, lambda work: 2.0)
    costs.learn("step", 1.0, 500.0)
    assert costs.upper_bound_ms("step", 1.0) < 4.0


@pytest.mark.parametrize("factor", [0.25, 4.0, 10.0])
def test_a_machine_that_changes_pace_is_followed(factor):
    costs = learned([1.0] * 50, lambda work: 2.0)
    for _ in range(150):
        costs.learn("step", 1.0, 2.0 * factor)
    assert costs.upper_bound_ms("step", 1.0) == pytest.approx(2.0 * factor, rel=0.3)


def test_no_estimate_is_negative_or_not_a_number():
    costs = learned([0.0, 0.0, 5.0], lambda work: 0.0)
    for work in (0.0, 1.0, 1e12):
        assert 0.0 <= costs.upper_bound_ms("step", work) < np.inf
    costs = learned([100.0, 1.0] * 9, lambda work: 1.0 / work)  # dearer the less there is to do
    assert costs.upper_bound_ms("step", 1000.0) >= 0.0


def test_the_cost_of_a_step_that_is_refused_decays():
    costs = learned([1.0, 1.0, 1.0], lambda work: 5.0)
    costs.learn("step", 1.0, 9.0)
    high = costs.upper_bound_ms("step", 1.0)
    for _ in range(20):
        costs.note_refusal("step")
    assert costs.upper_bound_ms("step", 1.0) < 0.9 * high
    for _ in range(300):
        costs.note_refusal("step")
    assert costs.upper_bound_ms("step", 1.0) < 1.0
    costs.note_refusal("other")
    assert costs.upper_bound_ms("other", 1.0) == 0.0


def refused(costs, times, step="step"):
    for _ in range(times):
        costs.note_refusal(step)


def test_a_step_that_was_tried_in_vain_is_as_dear_as_before():
    for end in ("runs", "abandoned"):
        costs = learned([1.0] * 50, lambda work: 5.0)
        refused(costs, 100)
        assert costs.upper_bound_ms("step", 1.0) < 2.0
        if end == "runs":
            costs.learn("step", 1.0, 5.0)
        else:
            costs.note_abandoned("step", 1.0, 3.0)
        assert costs.upper_bound_ms("step", 1.0) == pytest.approx(5.0)
    costs.note_abandoned("step", 1.0, 8.0)  # after 8 ms: it takes at least these
    assert costs.upper_bound_ms("step", 1.0) > 5.2


def test_a_step_that_was_tried_and_is_cheap_again_stays_so():
    costs = learned([1.0] * 50, lambda work: 5.0)
    refused(costs, 100)  # it was dear, because it was preempted
    costs.learn("step", 1.0, 1.0)
    assert costs.upper_bound_ms("step", 1.0) < 3.0


def beside_another_process(costs, times):
    """A short step, of 1 ms, which is preempted for 4 ms every fourth time."""
    for n in range(times):
        costs.learn("step", 1.0, *((5.0, 4.0) if n % 4 == 0 else (1.0, 0.0)))


def test_a_preempted_step_is_as_dear_as_its_own_work_and_the_share_of_waiting():
    costs = learned([1.0] * 50, lambda work: 1.0)
    beside_another_process(costs, 100)
    assert costs.upper_bound_ms("step", 1.0) == pytest.approx(2.0, rel=0.15)  # half of the time it waited


def test_the_share_of_waiting_is_common_to_all_steps():
    costs = learned([1.0] * 50, lambda work: 10.0, "long")
    alone = costs.upper_bound_ms("long", 1.0)
    beside_another_process(costs, 100)
    assert costs.upper_bound_ms("long", 1.0) == pytest.approx(2.0 * alone, rel=0.15)
    for _ in range(60):
        costs.learn("step", 1.0, 1.0)
    assert costs.upper_bound_ms("long", 1.0) == pytest.approx(alone, rel=0.05)  # the other process has ended


def test_a_first_run_that_compiled_is_forgotten_by_the_second():
    costs = Costs()
    costs.learn("step", 1.0, 20_000.0)
    assert costs.upper_bound_ms("step", 1.0) == pytest.approx(20_000.0)
    costs.learn("step", 1.0, 80.0, 30.0)
    assert costs.upper_bound_ms("step", 1.0) == pytest.approx(80.0)  # with the share of waiting


@pytest.mark.parametrize(("first_ms", "work", "ms"), [(280.0, 0.1, 30.0), (180.0, 1.0, 30.0), (280.0, 1.0, 150.0)])
def test_a_first_run_of_more_work_or_little_dearer_still_counts(first_ms, work, ms):
    costs = Costs()
    costs.learn("step", 1.0, first_ms)
    costs.learn("step", work, ms)
    assert costs.upper_bound_ms("step", 1.0) > 90.0


def test_one_preemption_among_tiny_steps_makes_a_long_one_little_dearer():
    """A few microseconds of work say little of the share of waiting."""
    costs = learned([1.0] * 50, lambda work: 1000.0, "long")
    for n in range(200):
        costs.learn("tiny", 1.0, *((30.0, 30.0) if n == 199 else (0.05, 0.0)))
    assert costs.upper_bound_ms("long", 1.0) < 1500.0


def test_a_long_step_beside_another_process_takes_what_it_took():
    costs = Costs()
    for _ in range(80):
        costs.learn("long", 1.0, 400.0, 200.0)
    assert costs.upper_bound_ms("long", 1.0) == pytest.approx(400.0, rel=0.05)


def test_one_stall_that_was_no_preemption_leaves_the_share_of_waiting():
    costs = Costs()
    for _ in range(50):
        costs.learn("step", 1.0, 2.0, 1.0)
    costs.learn("step", 1.0, 10_000.0)
    for _ in range(5):
        costs.learn("step", 1.0, 2.0, 1.0)
    assert costs.upper_bound_ms("step", 1.0) > 1.8


def test_a_step_that_only_waited_is_not_free():
    costs = Costs()
    for _ in range(5):
        costs.note_abandoned("step", 1.0, 8.0, 8.0)
    assert costs.upper_bound_ms("step", 1.0) > 4.0


def test_waiting_that_lets_no_step_run_decays():
    costs = learned([1.0] * 50, lambda work: 10.0)
    for _ in range(50):
        costs.learn("step", 1.0, 30.0, 20.0)
    dear = costs.upper_bound_ms("step", 1.0)
    assert dear == pytest.approx(30.0, rel=0.15)
    for _ in range(20):
        costs.note_idle()
    assert costs.upper_bound_ms("step", 1.0) < 0.5 * dear
    assert costs.upper_bound_ms("step", 1.0) == pytest.approx(10.0, rel=0.3)


def test_the_longest_preemption_is_remembered_for_some_frames():
    costs = Costs()
    assert costs.preemption_ms == 0.0
    costs.note_preemption(4.0)
    costs.note_preemption(1.0)
    assert costs.preemption_ms == 4.0
    for _ in range(5):
        costs.begin_frame()
    assert 2.0 < costs.preemption_ms < 3.0
    for _ in range(50):
        costs.begin_frame()
    assert costs.preemption_ms < 0.1


def test_what_a_try_may_lose_a_fix_by_is_tried_seldom():
    """The cost decays slowly, and its deviation as well; but a period in which it was dear is forgotten."""
    ms = cycle([2.0, 4.0])
    costs, freely = (learned([1.0] * 100, lambda _: next(ms)) for _ in range(2))
    for _ in range(30):
        costs.note_refusal("step", has_fix=True)
        freely.note_refusal("step")
    assert costs.upper_bound_ms("step", 1.0) > 5.0
    assert freely.upper_bound_ms("step", 1.0) < 3.0
    for _ in range(300):
        costs.note_refusal("step", has_fix=True)
    assert 2.0 < costs.upper_bound_ms("step", 1.0) < 3.5
    for _ in range(3000):
        costs.note_refusal("step", has_fix=True)
    assert costs.upper_bound_ms("step", 1.0) < 0.3
