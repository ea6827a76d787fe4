"""Work divided among threads: in order, whatever fails, and nobody works on after a failure."""

import threading
import time

import pytest

from engine.runtime import threads


@pytest.fixture(params=[1, 2, 4])
def count(request):
    before = threads.count()
    threads.set_threads(request.param)
    yield request.param
    threads.set_threads(before)


def test_results_come_in_the_order_of_the_pieces(count):
    assert threads.in_parallel(lambda n: (time.sleep(0.001 * (n % 3)), n)[1], range(20)) == list(range(20))
    assert threads.in_parallel(str, []) == []


def test_work_within_work_does_not_wait_for_itself(count):
    inner = lambda n: sum(threads.in_parallel(lambda m: n * m, range(5)))  # noqa: E731
    assert threads.in_parallel(inner, range(8)) == [10 * n for n in range(8)]


@pytest.mark.parametrize("who", ["the caller", "a worker", "either"])
def test_after_an_error_nothing_is_begun_and_nobody_works_on(count, who):
    caller, begun, ended, failed = threading.current_thread(), [], [], threading.Event()

    def work(number):
        begun.append(number)
        is_caller = threading.current_thread() is caller
        if count == 1 or who == "either" or is_caller == (who == "the caller"):
            failed.set()
            raise ValueError("no")
        failed.wait(60.0)
        time.sleep(0.02)
        ended.append(number)

    with pytest.raises(ValueError, match="no"):
        threads.in_parallel(work, range(50))
    assert len(begun) < 50
    seen = len(begun), len(ended)
    time.sleep(0.05)
    assert (len(begun), len(ended)) == seen
