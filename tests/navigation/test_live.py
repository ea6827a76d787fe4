"""The live pipeline: every frame answered once and in time, the newest first, and no fix under another's stamp."""

import threading
import time
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from engine import Live, LiveOptions, NavigatorOptions, StateError, TelemetryError
from engine.values import Fix, Frame, NoFix, Prior, Reason
from tests.support.fixes import a_fix
from tests.support.waiting import wait_until


def frame(number: int) -> Frame:
    return Frame(np.zeros((4, 4), np.uint8), number)


def fix(of: Frame) -> Fix:
    return a_fix(float(of.timestamp_ns or 0), timestamp_ns=of.timestamp_ns)


class Navigators:
    """Made one after the other; each takes its time, and on listed frames does something else.

    In place of such a list comes what making it does instead, which may fail.
    """

    def __init__(self, *odd, takes_ms: float = 0.0):
        self.odd, self.takes_ms, self.starts, self.budgets = list(odd), takes_ms, [], []

    def __call__(self, start):
        self.starts.append(start)
        odd = self.odd.pop(0) if self.odd else {}
        if callable(odd):
            odd()
            odd = {}
        return SimpleNamespace(update=partial(self.update, odd), options=NavigatorOptions(max_speed_mps=16.0))

    def update(self, odd, frame, prior=None, budget=None):
        self.budgets.append(budget.total_ms)
        if frame.timestamp_ns in odd:
            odd[frame.timestamp_ns]()
        time.sleep(self.takes_ms * 1e-3)
        return fix(frame)


class Gate:
    """Where a navigator hangs until a test opens it."""

    def __init__(self):
        self.begun, self.opened, self.left = threading.Event(), threading.Event(), []

    def __call__(self):
        self.begun.set()
        self.opened.wait(60.0)
        time.sleep(0.1)
        self.left.append(True)


def die():
    raise ZeroDivisionError("a bug")


def fail():
    raise OSError("map is gone")


class Clock:
    """Stands still until a test turns it."""

    def __init__(self):
        self.now_ns = 0

    def __call__(self):
        return self.now_ns

    def advance(self, ms):
        self.now_ns += round(ms * 1e6)


def reasons(answers):
    return [a.result.reason if isinstance(a.result, NoFix) else "fix" for a in answers]


def no_threads():
    return not [thread for thread in threading.enumerate() if thread.name.startswith("scenematch-_")]


def wait_for(answers, count: int):
    wait_until(lambda: len(answers) >= count)
    return answers


@contextmanager
def running(navigators, deadline_ms=60_000.0, patience_ms=1000.0, clock=None, fails=None):
    """A pipeline and its answers; whoever receives them may fail."""
    answers, options = [], LiveOptions(deadline_ms=deadline_ms, patience_ms=patience_ms)

    def deliver(answer):
        answers.append(answer)
        if fails is not None:
            raise fails

    with Live(navigators, deliver, options=options, clock_ns=clock) as live:
        yield live, answers


def send(live, answers, *numbers):
    """Submit frames, each once the one before it was answered; the ends of all that were."""
    for number in numbers:
        count = len(answers) + 1
        live.submit(frame(number))
        wait_for(answers, count)
    return reasons(answers)


def test_each_frame_has_its_own_fix():
    with running(Navigators()) as (live, answers):
        send(live, answers, *range(20))
    assert [a.result.timestamp_ns for a in answers] == list(range(20))
    assert all(a.frame.timestamp_ns == a.result.timestamp_ns == a.result.east_m for a in answers)
    assert (live.counts.submitted, live.counts.answered, live.counts.dropped, live.counts.late) == (20, 20, 0, 0)


def test_the_newest_wins_and_drops_are_counted():
    gate = Gate()
    with running(Navigators({0: gate})) as (live, answers):
        live.submit(frame(0))
        assert gate.begun.wait(60.0)
        for number in range(1, 8):
            live.submit(frame(number))
        gate.opened.set()
        wait_for(answers, 2)
    assert [a.frame.timestamp_ns for a in answers] == [0, 7]
    assert live.counts.dropped == 6


def test_an_answer_comes_at_the_deadline_and_the_late_fix_never():
    gate = Gate()
    with running(Navigators({0: gate}), deadline_ms=50, patience_ms=60_000) as (live, answers):
        assert send(live, answers, 0) == [Reason.LATE]
        gate.opened.set()
        send(live, answers, 1)
    assert [a.frame.timestamp_ns for a in answers] == [0, 1]
    assert live.counts.workers_replaced == 0


def test_the_navigator_is_given_what_is_left():
    navigators = Navigators()
    with running(navigators) as (live, answers):
        live.submit(frame(0), captured_ns=time.monotonic_ns() - 3_000_000_000)
        wait_for(answers, 1)
        live.submit(frame(1), captured_ns=time.monotonic_ns() - 61_000_000_000)
        wait_for(answers, 2)
    assert 0 < navigators.budgets[0] <= 57_000
    assert len(navigators.budgets) == 1  # nothing is begun that cannot be in time
    assert reasons(answers) == ["fix", Reason.LATE]
    assert answers[0].age_ms >= 3000


def test_a_worker_that_hangs_is_replaced_and_starts_from_the_last_fix():
    clock, gate = Clock(), Gate()
    navigators = Navigators({1: gate})
    with running(navigators, deadline_ms=1000, patience_ms=5, clock=clock) as (live, answers):
        send(live, answers, 0)
        live.submit(frame(1))
        assert gate.begun.wait(60.0)
        clock.advance(1500)
        wait_until(lambda: live.counts.workers_replaced)
        send(live, answers, 2)
        gate.opened.set()  # the one that hung comes back, and is not heard
        assert send(live, answers, 3) == ["fix", Reason.LATE, "fix", "fix"]
    assert [a.age_ms for a in answers] == [0.0, 1500.0, 0.0, 0.0]
    assert live.counts.workers_replaced == 1
    first, second = navigators.starts
    assert first is None
    assert (second.east_m, second.sigma_m) == (0.0, pytest.approx(1.0 + 16.0 * 1.5))
    assert [a.frame.timestamp_ns for a in answers] == [0, 1, 2, 3]


def test_a_worker_that_dies_before_any_fix_starts_where_the_vehicle_may_be_by_then():
    clock, navigators, answers = Clock(), Navigators({0: die}), []
    start = Prior(lat_deg=1.0, lon_deg=2.0, sigma_m=15.0)
    with Live(navigators, answers.append, start, LiveOptions(deadline_ms=60_000), clock) as live:
        clock.advance(2000)
        live.submit(frame(0))
        wait_until(lambda: len(navigators.starts) == 2)
    assert navigators.starts == [start, Prior(lat_deg=1.0, lon_deg=2.0, sigma_m=15.0 + 16.0 * 2.0)]


def test_a_navigator_that_is_on_a_wrong_track_is_started_where_it_should_be():
    navigators = Navigators()
    with running(navigators) as (live, answers):
        send(live, answers, 0)
        live.restart(Prior(east_m=7.0, north_m=8.0, sigma_m=2.0))
        assert send(live, answers, 1, 2) == ["fix"] * 3
    assert navigators.starts == [None, Prior(east_m=7.0, north_m=8.0, sigma_m=2.0)]
    assert live.counts.workers_replaced == 0


def test_a_worker_that_dies_is_replaced_and_its_frame_answered():
    navigators = Navigators({0: die})
    with running(navigators) as (live, answers):
        assert send(live, answers, 0, 1) == [Reason.FAILED, "fix"]
    assert "ZeroDivisionError: a bug" in answers[0].result.detail
    assert len(navigators.starts) == 2
    assert live.counts.workers_replaced == 1


def test_a_frame_that_cannot_be_used_costs_no_worker():
    def refuse():
        raise TelemetryError("timestamp_ns: expected later than 5, got 0")

    with running(Navigators({0: refuse})) as (live, answers):
        assert send(live, answers, 0) == [Reason.FAILED]
    assert live.counts.workers_replaced == 0


def test_a_receiver_that_fails_stops_nothing(caplog):
    with running(Navigators(), fails=ValueError("the receiver's own")) as (live, answers):
        assert send(live, answers, 0, 1, 2) == ["fix"] * 3
    assert "deliver failed" in caplog.text


def test_after_closing_there_is_nothing_more():
    with running(Navigators()) as (live, _):
        pass
    with pytest.raises(StateError, match="submit: expected an open pipeline"):
        live.submit(frame(0))
    wait_until(no_threads)


@pytest.mark.parametrize("patience_ms", [60_000, 30])
def test_closing_waits_for_a_worker_whose_frame_was_answered_without_it(patience_ms):
    """And for one that was given up: a process that ends while its thread is within compiled code is aborted."""
    gate, number = Gate(), 0
    with running(Navigators(dict.fromkeys(range(1000), gate)), 20, patience_ms) as (live, answers):
        while not gate.begun.is_set():  # on a machine that is busy a frame may be due before its work begins
            assert set(send(live, answers, number)) == {Reason.LATE}
            number += 1
        wait_until(lambda: patience_ms > 30 or live.counts.workers_replaced > 0)
        assert not gate.left
        gate.opened.set()
    assert gate.left


def test_a_maker_that_fails_is_asked_again_until_closing(caplog):
    navigators = Navigators({0: die}, *[fail] * 1000)
    with running(navigators, patience_ms=60) as (live, answers):
        send(live, answers, 0)
        wait_until(lambda: len(navigators.starts) > 2)
    wait_until(no_threads)
    assert "make_navigator failed" in caplog.text
    made, replaced = len(navigators.starts), live.counts.workers_replaced
    time.sleep(0.15)
    assert (len(navigators.starts), live.counts.workers_replaced) == (made, replaced)


def test_closing_does_not_replace_a_worker_that_hangs(monkeypatch):
    monkeypatch.setattr("engine.navigation.live._JOIN_S", 0.05)
    clock, gate = Clock(), Gate()
    navigators = Navigators({0: gate})
    with running(navigators, deadline_ms=500, patience_ms=100, clock=clock) as (live, answers):
        live.submit(frame(0))
        assert gate.begun.wait(60.0)
        clock.advance(500)
        assert reasons(wait_for(answers, 1)) == [Reason.LATE]
    wait_until(lambda: "scenematch-_watch" not in [thread.name for thread in threading.enumerate()])
    assert len(navigators.starts) == 1
    assert live.counts.workers_replaced == 0
    gate.opened.set()
    wait_until(no_threads)
