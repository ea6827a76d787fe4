"""Many frames at once: the answers of one at a time, in their order, by processes and by threads."""

import os
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from engine import Budget, Fix, Frame, MatcherOptions, NoFix, Prior, Reason, SceneMatcher, SiftOptions
from engine.errors import BackendError, CalibrationError, OptionError
from engine.runtime import workers as processes
from engine.runtime.step_costs import Costs
from tests.support.fixes import values_of
from tests.support.refusals import misuse, refusal
from tests.support.waiting import called_at_once, is_running, wait_until

PLACES = [np.array([300.0 + 6.0 * k, 290.0 + 4.0 * (k % 3)]) for k in range(6)]


@pytest.fixture(autouse=True)
def _started_at_once(monkeypatch):
    """Workers are started after the first task, however little work it is."""
    monkeypatch.setattr(processes, "_WORTH_S", 0.0)


@pytest.fixture(scope="module")
def questions(ground, camera):
    """Frames with their priors: places in a row, ways to be refused, and a search of the map."""
    angles = [{"heading_deg": 20.0 * k, "roll_deg": 2.0, "pitch_deg": -1.0} for k in range(len(PLACES))]
    frames = [ground.frame(camera, nadir, timestamp_ns=k, **angles[k]) for k, nadir in enumerate(PLACES)]
    priors = [ground.prior(nadir) for nadir in PLACES]
    flat = Frame(np.full((300, 300), 90, np.uint8), 100, 150.0, 0.0, 0.0, 0.0)
    frames += [flat, replace(frames[0], height_agl_m=None), frames[1], frames[2]]
    priors += [priors[0], priors[0], Prior(east_m=9e3, north_m=0.0, sigma_m=5.0), None]
    return frames, priors


@pytest.mark.parametrize(
    "method", ["ncc", *(pytest.param(method, marks=pytest.mark.slow) for method in ("sift", "auto"))]
)
def test_many_frames_have_the_answers_of_each_alone_in_order(matchers, questions, method):
    matcher, (frames, priors) = matchers[method], questions
    alone = [values_of(matcher.locate(frame, prior)) for frame, prior in zip(frames, priors, strict=True)]
    for workers in (1, 3):
        together = matcher.locate_many(frames, priors, workers=workers)
        assert [values_of(result) for result in together] == alone
    assert {Fix, NoFix} == {type(result) for result in together}
    assert together[6].reason is Reason.NO_TEXTURE
    assert together[8].reason is Reason.OUTSIDE_MAP


def test_other_processes_did_the_work(matchers, questions, monkeypatch):
    matcher, (frames, priors) = matchers["ncc"], questions
    here = []
    locate = matcher.locate
    monkeypatch.setattr(matcher, "locate", lambda *question: here.append(question) or locate(*question))
    assert len(matcher.locate_many(frames, priors, workers=2)) == len(frames)
    assert len(here) == 1


def test_threads_of_ones_own_may_share_a_matcher(matchers, ground, camera, questions):
    asked = list(zip(*(part[4:] for part in questions), strict=True))
    for method in ("ncc", "sift"):
        expected = [values_of(matchers[method].locate(*question)) for question in asked]
        shared = SceneMatcher(ground.site, camera, method, "cpu")  # nothing is cached yet
        found = called_at_once(lambda question, shared=shared: shared.locate(*question), asked * 2)
        assert [values_of(result) for result in found] == expected * 2


def test_threads_learn_one_cost_while_others_ask_for_it():
    costs = Costs()

    def learn_and_ask(work):
        costs.learn("step", work, 2.0 * work, 2.0 * work)
        costs.note_stage(2.0 * work, 2.0 * work)
        return costs.needed_ms("step", 100.0)

    works = [float(work) for work in range(1, 200)] * 8
    assert called_at_once(learn_and_ask, works)[-1] == pytest.approx(200.0, rel=1e-6)


def test_no_frames_have_no_answers(matchers):
    assert matchers["ncc"].locate_many([], []) == []


def test_every_frame_has_the_budget(matchers, questions):
    frames, priors = questions
    refused = matchers["ncc"].locate_many(frames[:6], priors[:6], Budget(total_ms=1e-6), workers=2)
    assert {result.reason for result in refused} == {Reason.LATE}


def test_frames_and_priors_of_different_number_are_refused(matchers, questions):
    frames, priors = questions
    assert misuse(matchers["ncc"].locate_many, frames, priors[1:]) == "priors: expected one per frame, 10, got 9"


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_names_the_first_frame_that_has_it(matchers, questions, workers):
    frames, priors = list(questions[0]), questions[1]
    for index in (4, 7):
        frames[index] = replace(frames[index], image=np.zeros((10, 20 + index), np.uint8))
    with pytest.raises(CalibrationError, match=r"^frames\[4\]: camera: calibrated .* frame is 24 x 10$"):
        matchers["ncc"].locate_many(frames, priors, workers=workers)


def _fails(_frame, _crop):
    raise ZeroDivisionError("a matcher of one's own")


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_somebody_elses_code_is_theirs_and_names_the_frame(ground, camera, questions, workers):
    frames, priors = (part[:4] for part in questions)
    matcher = SceneMatcher(ground.site, camera, "sift", "cpu", MatcherOptions(sift=SiftOptions(matcher=_fails)))
    with pytest.raises(ZeroDivisionError, match="of one's own") as caught:
        matcher.locate_many(frames, priors, workers=workers)
    assert "It is of frames[0]." in caught.value.__notes__


def test_workers_are_refused_by_what_there_is(matchers, ground, questions, monkeypatch):
    matcher = matchers["ncc"]
    for owner, name, value, workers, words in (
        (matcher, "device", matcher.device, 0, r"1 or more, got 0$"),
        (processes.sys, "platform", "darwin", 2, r"1 here: only Linux forks"),
        (matcher, "device", torch.device("cuda:0"), 2, r"1 on cuda:0, got 2$"),
        (type(ground.site), "reads_files", True, 2, r"1 with .*, which is read from its file"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, value)
            with pytest.raises(OptionError, match=rf"^workers: expected {words}"):
                matcher.locate_many(*questions, workers=workers)


def test_nothing_is_forked_beside_other_threads():
    leave = threading.Event()
    other = threading.Thread(target=leave.wait)
    other.start()
    try:
        assert processes.safe_count() == 1
    finally:
        leave.set()
        other.join()


def test_a_worker_that_ends_is_an_error_and_leaves_no_process():
    parent = os.getpid()

    def ends(task):
        if os.getpid() != parent:
            os._exit(7)
        return task

    assert refusal(list, processes.in_order(ends, 20, 2), error=BackendError) == "workers: a process ended"


def test_workers_end_with_who_no_longer_asks():
    results = processes.in_order(lambda _: os.getpid(), 100, 2)
    assert next(results) == os.getpid()
    worker = next(results)
    results.close()
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks")
def test_workers_end_with_their_parent():
    """Also where it is killed, and can end none of them."""
    code = (
        "import os, time; from engine.runtime.workers import in_order\n"
        "for task in in_order(lambda n: time.sleep(0.1) or os.getpid(), 1000, 3): print(task, flush=True)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = {int(parent.stdout.readline()) for _ in range(12)} - {parent.pid}
        parent.kill()
    assert len(pids) > 1
    wait_until(lambda: not any(map(is_running, pids)), 10.0)
