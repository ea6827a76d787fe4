"""The live pipeline: every frame answered once and in time, the newest first, and no fix under another's stamp."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from engine.errors import OptionError, StateError, TelemetryError
from engine.navigation.live import Live, LiveOptions
from engine.values import Fix, Frame, NoFix, Reason
from tests.support.fixes import a_fix

IMAGE = np.zeros((4, 4), np.uint8)


def frame(number: int) -> Frame:
    return Frame(IMAGE, number)


def fix(of: Frame) -> Fix:
    return a_fix(float(of.timestamp_ns or 0), timestamp_ns=of.timestamp_ns)


class Slow:
    """A navigator that takes its time; on frames that are listed it does something else."""

    def __init__(self, takes_ms: float, odd=None):
        self.takes_ms, self.odd, self.budgets = takes_ms, odd or {}, []

    def update(self, frame, prior=None, budget=None):
        self.budgets.append(budget.total_ms)
        if frame.timestamp_ns in self.odd:
            self.odd[frame.timestamp_ns]()
        time.sleep(self.takes_ms * 1e-3)
        return fix(frame)


class Gate:
    """Where a navigator hangs until a test opens it."""

    def __init__(self, leaves_after_s: float = 0.0):
        self.begun, self.opened, self.left = threading.Event(), threading.Event(), []
        self.leaves_after_s = leaves_after_s

    def __call__(self):
        self.begun.set()
        self.opened.wait(60.0)
        time.sleep(self.leaves_after_s)
        self.left.append(True)


def die():
    raise ZeroDivisionError("a bug")


class Sink:
    """Collects answers and lets a test wait for them."""

    def __init__(self):
        self.answers, self.changed = [], threading.Condition()

    def __call__(self, answer):
        with self.changed:
            self.answers.append(answer)
            self.changed.notify_all()

    def wait_for(self, count: int, timeout_s: float = 60.0):
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.answers) >= count, timeout_s), self.answers
            return list(self.answers)


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


def wait_until(condition, timeout_s: float = 60.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.005)


def test_each_frame_has_its_own_fix():
    sink, navigator = Sink(), Slow(0)
    with Live(lambda start: navigator, sink, options=LiveOptions(deadline_ms=60_000)) as live:
        for number in range(20):
            live.submit(frame(number))
            sink.wait_for(number + 1)
    assert [a.result.timestamp_ns for a in sink.answers] == list(range(20))
    assert all(a.frame.timestamp_ns == a.result.timestamp_ns == a.result.east_m for a in sink.answers)
    assert (live.counts.submitted, live.counts.answered, live.counts.dropped, live.counts.late) == (20, 20, 0, 0)


def test_the_newest_wins_and_drops_are_counted():
    gate, sink = Gate(), Sink()
    with Live(lambda start: Slow(0, {0: gate}), sink, options=LiveOptions(deadline_ms=60_000)) as live:
        live.submit(frame(0))
        assert gate.begun.wait(60.0)
        for number in range(1, 8):
            live.submit(frame(number))
        gate.opened.set()
        answers = sink.wait_for(2)
    assert [a.frame.timestamp_ns for a in answers] == [0, 7]
    assert live.counts.dropped == 6


@pytest.mark.slow
@pytest.mark.parametrize("times", [2, 5, 10])
def test_more_frames_than_it_can_take(times):
    """The age at output stays within the deadline and one frame, however many come."""
    takes_ms, sink = 20.0, Sink()
    options = LiveOptions(deadline_ms=60)
    begun_ns = time.monotonic_ns()
    with Live(lambda start: Slow(takes_ms), sink, options=options) as live:
        for number in range(30 * times):
            live.submit(frame(number))
            time.sleep(takes_ms / times * 1e-3)
        sink.wait_for(5)
    counts, took_ms = live.counts, (time.monotonic_ns() - begun_ns) * 1e-6
    assert counts.submitted == 30 * times == counts.answered + counts.dropped
    assert counts.answered <= took_ms / takes_ms + took_ms / options.deadline_ms + 2  # one in work, one that waits
    stamps = [a.frame.timestamp_ns for a in sink.answers]
    assert stamps == sorted(set(stamps))
    assert all(isinstance(a.result, NoFix) or a.age_ms <= 60 for a in sink.answers)


def test_an_answer_comes_at_the_deadline_and_the_late_fix_never():
    gate, sink = Gate(), Sink()
    options = LiveOptions(deadline_ms=50, patience_ms=60_000)
    with Live(lambda start: Slow(0, {0: gate}), sink, options=options) as live:
        live.submit(frame(0))
        assert reasons(sink.wait_for(1)) == [Reason.LATE]
        gate.opened.set()
        live.submit(frame(1))
        sink.wait_for(2)
    assert [a.frame.timestamp_ns for a in sink.answers] == [0, 1]
    assert live.counts.workers_replaced == 0


def test_the_navigator_is_given_what_is_left():
    sink, navigator = Sink(), Slow(0)
    with Live(lambda start: navigator, sink, options=LiveOptions(deadline_ms=60_000)) as live:
        live.submit(frame(0), captured_ns=time.monotonic_ns() - 3_000_000_000)
        sink.wait_for(1)
        live.submit(frame(1), captured_ns=time.monotonic_ns() - 61_000_000_000)
        answers = sink.wait_for(2)
    assert 0 < navigator.budgets[0] <= 57_000
    assert len(navigator.budgets) == 1  # nothing is begun that cannot be in time
    assert reasons(answers) == ["fix", Reason.LATE]
    assert answers[0].age_ms >= 3000


def test_a_worker_that_hangs_is_replaced_and_starts_from_the_last_fix():
    clock, gate, sink, starts = Clock(), Gate(), Sink(), []

    def make(start):
        starts.append(start)
        return Slow(0, {1: gate} if len(starts) == 1 else {})

    options = LiveOptions(deadline_ms=1000, patience_ms=500)
    with Live(make, sink, options=options, clock_ns=clock, machine_ns=clock) as live:
        live.submit(frame(0))
        sink.wait_for(1)
        live.submit(frame(1))
        assert gate.begun.wait(60.0)
        clock.advance(1000)
        sink.wait_for(2)
        clock.advance(500)
        wait_until(lambda: live.counts.workers_replaced)
        live.submit(frame(2))
        sink.wait_for(3)
        gate.opened.set()  # the one that hung comes back, and is not heard
        live.submit(frame(3))
        sink.wait_for(4)
    assert reasons(sink.answers) == ["fix", Reason.LATE, "fix", "fix"]
    assert [a.age_ms for a in sink.answers] == [0.0, 1000.0, 0.0, 0.0]
    assert live.counts.workers_replaced == 1
    assert starts[0] is None
    assert (starts[1].east_m, starts[1].sigma_m) == (0.0, 1.0 + 15.0 * 1.5)
    assert [a.frame.timestamp_ns for a in sink.answers] == [0, 1, 2, 3]


def test_a_worker_that_dies_is_replaced_and_its_frame_answered():
    sink, made = Sink(), []

    def make(start):
        made.append(Slow(0, {} if made else {0: die}))
        return made[-1]

    with Live(make, sink, options=LiveOptions(deadline_ms=60_000)) as live:
        live.submit(frame(0))
        sink.wait_for(1)
        live.submit(frame(1))
        answers = sink.wait_for(2)
    assert reasons(answers) == [Reason.FAILED, "fix"]
    assert "ZeroDivisionError: a bug" in answers[0].result.detail
    assert len(made) == 2
    assert live.counts.workers_replaced == 1


def test_a_frame_that_cannot_be_used_costs_no_worker():
    def refuse():
        raise TelemetryError("timestamp_ns: expected later than 5, got 0")

    sink = Sink()
    with Live(lambda start: Slow(0, {0: refuse}), sink, options=LiveOptions(deadline_ms=60_000)) as live:
        live.submit(frame(0))
        answers = sink.wait_for(1)
    assert reasons(answers) == [Reason.FAILED]
    assert live.counts.workers_replaced == 0


@pytest.mark.slow
def test_a_maker_that_fails_is_asked_again(caplog):
    sink, calls = Sink(), []

    def make(start):
        calls.append(start)
        if len(calls) == 2:
            raise OSError("map is gone")
        return Slow(0, {0: die} if len(calls) == 1 else {})

    with Live(make, sink, options=LiveOptions(deadline_ms=1000, patience_ms=1000)) as live:
        live.submit(frame(0))
        sink.wait_for(1)
        number = 1
        while reasons(sink.answers)[-1] != "fix":
            live.submit(frame(number))
            sink.wait_for(number + 1)
            number += 1
    assert len(calls) == 3
    assert "make_navigator failed" in caplog.text


def test_a_receiver_that_fails_stops_nothing(caplog):
    sink = Sink()

    def deliver(answer):
        sink(answer)
        raise ValueError("the receiver's own")

    with Live(lambda start: Slow(0), deliver, options=LiveOptions(deadline_ms=60_000)) as live:
        for number in range(3):
            live.submit(frame(number))
            sink.wait_for(number + 1)
    assert reasons(sink.answers) == ["fix"] * 3
    assert "deliver failed" in caplog.text


def test_after_closing_there_is_nothing_more():
    live = Live(lambda start: Slow(0), lambda answer: None)
    live.close()
    with pytest.raises(StateError, match="submit: expected an open pipeline"):
        live.submit(frame(0))
    wait_until(no_threads)


def submit_until_begun(live, sink, gate):
    """On a machine that is busy a frame may be due before its work begins."""
    for number in range(1000):
        live.submit(frame(number))
        assert reasons(sink.wait_for(number + 1)) == [Reason.LATE] * (number + 1)
        if gate.begun.is_set():
            return


def test_closing_waits_for_a_worker_whose_frame_was_answered_without_it():
    gate, sink = Gate(), Sink()
    navigator = Slow(0, dict.fromkeys(range(1000), gate))
    live = Live(lambda start: navigator, sink, options=LiveOptions(deadline_ms=20, patience_ms=60_000))
    submit_until_begun(live, sink, gate)
    threading.Timer(0.1, gate.opened.set).start()
    live.close()
    assert gate.left


def test_closing_ends_the_attempts_of_a_maker_that_fails(caplog):
    calls, sink = [], Sink()

    def make(start):
        calls.append(start)
        if len(calls) > 1:
            raise OSError("map is gone")
        return Slow(0, {0: die})

    live = Live(make, sink, options=LiveOptions(deadline_ms=60_000, patience_ms=60))
    live.submit(frame(0))
    sink.wait_for(1)
    wait_until(lambda: len(calls) > 1)
    live.close()
    wait_until(no_threads, timeout_s=60.0)
    made, replaced = len(calls), live.counts.workers_replaced
    time.sleep(0.15)
    assert (len(calls), live.counts.workers_replaced) == (made, replaced)


def test_closing_waits_for_a_worker_that_was_given_up():
    """A process that ends while a thread of its is within compiled code is aborted."""
    gate, sink = Gate(leaves_after_s=0.3), Sink()
    navigator = Slow(0, dict.fromkeys(range(1000), gate))
    with Live(lambda _: navigator, sink, options=LiveOptions(deadline_ms=20, patience_ms=30)) as live:
        submit_until_begun(live, sink, gate)
        wait_until(lambda: live.counts.workers_replaced > 0)
        assert not gate.left
        gate.opened.set()
    assert gate.left


@pytest.mark.parametrize("name", ["deadline_ms", "patience_ms"])
@pytest.mark.parametrize(
    ("value", "wanted"), [(1e13, "at most 60000, got 1e\\+13"), (0, "a number above 0, got 0")]
)
def test_what_is_waited_for_is_above_0_and_at_most_a_minute(name, value, wanted):
    with pytest.raises(OptionError, match=f"{name}: expected {wanted}"):
        LiveOptions(**{name: value})


def test_closing_does_not_replace_a_worker_that_hangs(monkeypatch):
    monkeypatch.setattr("engine.navigation.live._JOIN_S", 0.05)
    clock, gate, sink, starts = Clock(), Gate(), Sink(), []

    def make(start):
        starts.append(start)
        return Slow(0, {0: gate})

    options = LiveOptions(deadline_ms=500, patience_ms=100)
    with Live(make, sink, options=options, clock_ns=clock, machine_ns=clock) as live:
        live.submit(frame(0))
        assert gate.begun.wait(60.0)
        clock.advance(500)
        assert reasons(sink.wait_for(1)) == [Reason.LATE]
    clock.advance(100)
    wait_until(lambda: "scenematch-_watch" not in [thread.name for thread in threading.enumerate()])
    assert len(starts) == 1
    assert live.counts.workers_replaced == 0
    gate.opened.set()
    wait_until(no_threads)


def test_a_worker_that_hangs_in_making_its_navigator_is_replaced():
    clock, gate, sink, calls = Clock(), threading.Event(), Sink(), []

    def make(start):
        calls.append(clock() * 1e-6)
        if 1 < len(calls) < 4:
            gate.wait()
        return Slow(0, {0: die} if len(calls) == 1 else {})

    options = LiveOptions(deadline_ms=100, patience_ms=10)
    with Live(make, sink, options=options, clock_ns=clock, machine_ns=clock) as live:
        live.submit(frame(0))
        sink.wait_for(1)
        wait_until(lambda: len(calls) == 2)
        live.submit(frame(1))
        clock.advance(100)
        assert reasons(sink.wait_for(2))[-1] is Reason.LATE  # nothing waits for longer than its deadline
        for made in (3, 4):
            wait_until(lambda made=made: clock.advance(1) or len(calls) == made)
        live.submit(frame(2))
        sink.wait_for(3)
        gate.set()  # those that hung come back, and are not heard
        live.submit(frame(3))
        assert reasons(sink.wait_for(4))[2:] == ["fix", "fix"]
    assert live.counts.workers_replaced == 3
    # A maker that is only slow comes through in the end: each is waited for twice as long as the one before.
    assert calls[2] - calls[1] >= 110.0
    assert calls[3] - calls[2] >= 220.0
