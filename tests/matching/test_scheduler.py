"""The scheduler: what is done of each method within a budget, and what is refused before it is begun."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numba.core.event import install_recorder

from engine import Budget, Fix, MatcherOptions, NccOptions, NoFix, Reason, SceneMatcher
from engine.matching.ncc import Ncc, _Rungs
from engine.matching.refinement import Refinement
from engine.runtime.scheduler import OutOfTime, Scheduler
from engine.runtime.step_costs import Costs
from tests.support.fixes import px_off

NADIR = np.array([315.0, 296.0])
HURRY = Budget(total_ms=1e6)  # finite, so that costs count, and never over


class FixedCosts:
    """Costs that a test sets, per step and unit of work; nothing is learned."""

    def __init__(self, **per_unit):
        self.per_unit = {name.replace("_", " "): cost for name, cost in per_unit.items()}
        self.longest_wait_ms = 0.0

    def needed_ms(self, step, work, *, has_fix=True):
        step = step if isinstance(step, str) else step[0]  # one variant of it
        if not isinstance(step, str):
            return 0.0  # a stage of a step
        for suffix in (" at once", " of sift", " by few features"):  # other ways of the same step
            step = step.removesuffix(suffix)
        return self.per_unit.get(step, 0.0) * work

    def least_ms(self, step, work):
        return self.needed_ms(step, work)

    def learn(self, *_, **__):
        pass

    note_refusal = note_stage = learn

    def load(self):
        return 1.0

    def wait_ms(self):
        return self.longest_wait_ms


@pytest.fixture
def make(site, camera):
    def made(method, **per_unit):
        matcher = SceneMatcher(site, camera, method, "cpu")
        matcher._costs = FixedCosts(**per_unit)
        return matcher

    return made


def test_a_fix_that_there_is_no_time_to_refine_is_put_out_as_it_is(make, frame, prior):
    fix, fine = make("ncc", refinement=1e9).locate(frame, prior, HURRY), make("ncc").locate(frame, prior, HURRY)
    assert (fix.stage, fix.up_m, fine.stage) == ("fine", None, "refined")
    assert fine.sigma_m <= fix.sigma_m


@pytest.mark.parametrize("method", ["ncc", "sift"])
def test_with_less_time_a_coarse_fix_of_the_same_place(make, frame, prior, method):
    per_unit = {method: cost_of_the_finest(make, frame, prior, method)}
    fix = make(method, **per_unit, refinement=1e9).locate(frame, prior, HURRY)
    assert px_off(fix, NADIR) < 6
    assert fix.stage == "coarse"


def cost_of_the_finest(make, frame, prior, method):
    """Per unit of work, so that the finest variant of the method's step takes 1.5 times the budget."""
    probe, work = make(method, refinement=1e9), []
    known = probe._costs.needed_ms

    def noting(name, amount, **how):
        work.extend([amount] if name[0] == method else [])
        return known(name, amount, **how)

    probe._costs.needed_ms = noting
    probe.locate(frame, prior, HURRY)
    return 1.5 * HURRY.total_ms / max(work)


def test_a_pose_is_refined_from_a_coarse_peak_as_from_a_fine_one(make, frame, prior, monkeypatch):
    """Where there is no time for the finest level; and where there is, the coarse one is enough."""
    hurried = make("ncc", ncc=cost_of_the_finest(make, frame, prior, "ncc")).locate(frame, prior, HURRY)
    by_coarse = make("ncc").locate(frame, prior)
    monkeypatch.setattr(_Rungs, "_if_coarse_suffices", lambda self, answer: {})
    by_fine = make("ncc").locate(frame, prior)
    for fix in (hurried, by_coarse, by_fine):
        assert px_off(fix, NADIR) < 0.6
        assert fix.stage == "refined"
    apart_m = np.hypot(by_coarse.east_m - by_fine.east_m, by_coarse.north_m - by_fine.north_m)
    assert apart_m < by_fine.relative_sigma_m


def out_of_time(*_, **__):
    raise OutOfTime


def test_steps_that_are_abandoned_leave_the_coarse_fix(make, frame, prior, monkeypatch):
    monkeypatch.setattr(Refinement, "refine_at_once", out_of_time)
    monkeypatch.setattr(_Rungs, "_correlate", out_of_time)
    fix = make("ncc").locate(frame, prior, HURRY)
    assert px_off(fix, NADIR) < 6
    assert fix.stage == "coarse"


@pytest.mark.parametrize(
    ("off_m", "expected"),
    [
        (1.0, "coarse"),  # a finer peak of the same place
        (8.0, Reason.AMBIGUOUS),  # a rival is farther off than 6 m
        (60.0, Reason.AMBIGUOUS),
        (Reason.LATE, "coarse"),
        (Reason.OUTSIDE_MAP, Reason.OUTSIDE_MAP),
    ],
)
def test_a_coarse_fix_stands_unless_the_finer_peak_contradicts(make, frame, prior, monkeypatch, off_m, expected):
    """Its evidence is that of a finer peak of the same place, which makes nothing more certain."""
    monkeypatch.setattr(Refinement, "refine_at_once", lambda _self, _fix: None)
    monkeypatch.setattr(Refinement, "refine", out_of_time)
    monkeypatch.setattr(Ncc, "match_structure", out_of_time)
    correlate, coarse = Ncc.find, []

    def refused(self, query, *, coarser=0, **how):
        if coarser > 1:
            coarse.append(correlate(self, query, coarser=coarser, **how))
            return coarse[0]
        if isinstance(off_m, Reason):
            return query.refuse(off_m, "of the finer peak", "ncc")
        weak = coarse[0].weighed(replace(coarse[0].evidence, surprise=60.0, rival=60.0))
        return replace(weak, fix=replace(weak.fix, east_m=coarse[0].fix.east_m + off_m))

    monkeypatch.setattr(Ncc, "find", refused)
    result = make("ncc").locate(frame, prior, HURRY)
    assert (result.stage if isinstance(result, Fix) else result.reason) == expected
    if isinstance(result, Fix):  # refinement did not confirm the tilt
        assert result.confidence == coarse[0].fix.confidence == pytest.approx(1.0, abs=1e-3)
        assert result.relative_sigma_m > 3.5


@pytest.mark.parametrize("finer", [(), (1,), (1, 0)])
def test_a_coarse_fix_that_is_not_confirmed_is_uncertain_at_any_level(make, frame, prior, monkeypatch, finer):
    """And no level is correlated twice."""
    monkeypatch.setattr(Refinement, "refine_at_once", lambda _self, _fix: None)
    monkeypatch.setattr(Refinement, "refine", lambda _self, found: found)
    correlated, find = [], Ncc.find

    def noted(self, query, *, coarser=0, **options):
        correlated.append(coarser)
        return find(self, query, coarser=coarser, **options)

    monkeypatch.setattr(Ncc, "find", noted)
    matcher = make("ncc")
    too_dear = {("ncc", level) for level in (0, 1)} - {("ncc", level) for level in finer}
    monkeypatch.setattr(Scheduler, "can_afford", lambda _self, works: not too_dear & set(works))
    fix = matcher.locate(frame, prior, HURRY)
    assert correlated == [2, *finer[-1:]]
    assert (fix.relative_sigma_m > 3.5) == (fix.stage == "coarse")


def test_refinement_at_once_is_begun_only_where_there_is_time_for_it(make, frame, prior, monkeypatch):
    """What comes before it may have taken longer than thought."""
    matcher = make("ncc")
    search_coarsely = _Rungs._search_coarsely

    def slow(self, *args):
        found = search_coarsely(self, *args)
        matcher._costs.per_unit = {"refinement": 1e9, "ncc": 1e9}
        return found

    monkeypatch.setattr(_Rungs, "_search_coarsely", slow)
    fix = matcher.locate(frame, prior, HURRY)
    assert px_off(fix, NADIR) < 6
    assert fix.stage == "coarse"


@pytest.mark.parametrize(
    ("method", "step", "work"), [("ncc", "refinement at once", 9e4), ("sift", "sift by few features", 3e4)]
)
def test_a_short_way_once_too_dear_is_tried_again(site, camera, frame, prior, monkeypatch, method, step, work):
    """Without it every frame takes the long way, which is dearer yet."""
    monkeypatch.setattr(Costs, "load", lambda _self: 1.0)  # whatever else this machine does
    matcher = SceneMatcher(site, camera, method, "cpu")
    for _ in range(2):
        matcher._costs.learn(step, work, 1e7, 1e7)
    before_ms = matcher._costs.needed_ms(step, work)
    for _ in range(40):
        matcher.locate(frame, prior, Budget(total_ms=0.9 * before_ms))
    assert matcher._costs.needed_ms(step, work) < 0.5 * before_ms


def test_beside_a_fix_a_step_leaves_room_for_a_preemption(make, frame, prior, monkeypatch):
    """Which would lose the fix; without one the step is tried all the same."""
    monkeypatch.setattr("engine.matching.ladder.is_beyond_doubt", lambda *_: False)
    matcher = make("auto")
    assert matcher.locate(frame, prior, HURRY).stage == "verified"
    matcher._costs.longest_wait_ms = 0.9 * HURRY.total_ms
    assert matcher.locate(frame, prior, HURRY).stage == "verified"
    matcher._costs.longest_wait_ms = HURRY.total_ms
    fix = matcher.locate(frame, prior, HURRY)
    assert px_off(fix, NADIR) < 6
    assert (fix.method, fix.stage) == ("ncc", "coarse")


@pytest.mark.parametrize("method", ["ncc", "sift", "auto"])
def test_what_cannot_be_in_time_is_not_begun(make, frame, prior, method):
    result = make(method, ncc=1e9, sift=1e9).locate(frame, prior, HURRY)
    assert result.reason is Reason.LATE
    assert "takes longer" in result.detail
    assert list(result.timings.stages_ms) == ["grey"]


@pytest.mark.parametrize(("costs", "method"), [({"sift": 1e9}, "ncc"), ({"ncc": 1e9}, "sift")])
def test_with_time_for_one_method_there_is_one(make, frame, prior, costs, method):
    fix = make("auto", **costs).locate(frame, prior, HURRY)
    assert px_off(fix, NADIR) < 2
    assert (fix.stage, fix.method) == ("refined", method)


def test_a_search_of_the_whole_map_has_a_budget_of_its_own(make, frame):
    dear = {"ncc_search": 1.0}
    assert make("ncc", **dear).locate(frame, None, Budget(total_ms=1e4)).reason is Reason.LATE
    assert px_off(make("ncc", **dear).locate(frame, None, Budget(total_ms=1e4, search_ms=np.inf)), NADIR) < 3


@pytest.fixture(scope="module")
def warm(site, camera):
    """Matchers after their warm-up, and what it reported."""

    @cache
    def warmed(method):
        matcher, seen = SceneMatcher(site, camera, method, "cpu"), []
        matcher.warmup(lambda done, total: seen.append((done, total)))
        return matcher, seen

    return warmed


def test_costs_are_learned_and_then_kept_to(warm, frame, prior):
    matcher, _ = warm("auto")
    for step, work in (("ncc", 1e5), ("sift", 22_500.0), ("ncc search", 1e5), ("sift search", 22_500.0)):
        assert all(matcher._costs.needed_ms(key, work) > 0.0 for key in known_steps(matcher) if key[0] == step)
    assert isinstance(matcher.locate(frame, prior, Budget(total_ms=1e4)), Fix)
    assert matcher.locate(frame, prior, Budget(total_ms=0.3)).reason is Reason.LATE


def known_steps(matcher):
    return [key for key in matcher._costs._runs if isinstance(key, tuple) and isinstance(key[0], str)]


def test_a_cost_that_is_refused_fades_until_it_is_tried_again(ground, camera, frame, prior):
    matcher = SceneMatcher(ground.site, camera, "ncc", "cpu")
    for level in (0, 1, 2):
        for _ in range(9):  # the machine was slow
            matcher._costs.learn(("ncc", level), 1.0, 2.0, 2.0)
    results = [matcher.locate(frame, prior, Budget(total_ms=2e4)) for _ in range(300)]
    assert isinstance(results[0], NoFix)
    assert isinstance(results[-1], Fix)


def test_a_vague_prior_does_not_raise_the_cost_of_a_sharp_one(site, camera, frame, prior):
    """A window is never larger than the map, whatever the prior says: neither is what it is thought to cost."""
    matcher = SceneMatcher(site, camera, "ncc", "cpu")
    for vague in (5.0, 1e6, 5.0, 1e6):
        matcher.locate(frame, replace(prior, sigma_m=vague))
    assert isinstance(matcher.locate(frame, prior, Budget(total_ms=3_600_000.0)), Fix)


@pytest.mark.parametrize(
    ("method", "changed"),
    [
        ("auto", {}),
        ("sift", {"heading_deg": 6.0}),  # refinement has to begin on a coarser level
        ("ncc", {"roll_deg": None, "pitch_deg": None}),
        ("ncc", {"image": np.random.default_rng(0).integers(0, 255, (300, 300), np.uint8)}),
    ],
    ids=["usual", "another heading", "no tilt", "refused"],
)
def test_after_warmup_nothing_is_prepared_or_compiled_in_flight(ground, warm, camera, method, changed):
    matcher, _ = warm(method)
    before = matcher.cache_counters
    assert all(count > 0 for count in before.values())
    with install_recorder("numba:compiler_lock") as compiled:
        for number in range(8):
            place = NADIR + np.array([4.0, -3.0]) * number
            frame = ground.frame(camera, place, 120.0 + 8 * number, heading_deg=40.0 * number)
            matcher.locate(replace(frame, **changed), ground.prior(place, sigma_m=5.0 + number))
    assert matcher.cache_counters == before
    assert compiled.buffer == []


def test_warmup_knows_the_cost_of_a_search(site, camera):
    matcher = SceneMatcher(site, camera, "ncc", "cpu", MatcherOptions(ncc=NccOptions(refine=False)))
    matcher.warmup()
    assert matcher._costs.needed_ms("ncc hypotheses", 1e5) > 0.0


def test_a_late_frame_before_the_warm_up_says_so(site, camera, frame, prior, warm):
    """And no other."""
    matchers = SceneMatcher(site, camera, "ncc", "cpu"), warm("ncc")[0]
    cold, after = (matcher.locate(frame, prior, Budget(total_ms=1e-6)) for matcher in matchers)
    assert cold.reason is after.reason is Reason.LATE
    assert cold.detail.endswith("; compiling: call warmup() before take-off")
    assert "compiling" not in after.detail


def test_warmup_reports_what_it_compiles(warm):
    _, seen = warm("ncc")
    assert [done for done, _ in seen] == list(range(1, len(seen) + 1))
    assert {total for _, total in seen} == {len(seen)}
