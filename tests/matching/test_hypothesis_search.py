"""The bank of headings and heights, frame by frame over a simulated town: the right place, or a refusal."""

from dataclasses import replace

import numpy as np
import pytest

from engine import Fix, MatcherOptions, NccOptions, NoFix, Prior, SceneMatcher
from engine.matching import hypothesis_search
from engine.window import SPREAD_SIGMAS
from scenematch.simulator import FlightStyle, SensorNoise, plan_flight
from tests.support.towns import drawn_flight, drawn_town, site_of

EXACT = SensorNoise(**dict.fromkeys(SensorNoise.__dataclass_fields__, 0.0))
PLACES = (0, 5, 9, 13)
REACH = {"heading_sigma_deg": 5.0 / SPREAD_SIGMAS, "height_sigma_m": 0.05 * 120.0 / SPREAD_SIGMAS}
ANY_HEADING = {"heading_deg": 123.0, "heading_sigma_deg": 180.0}
# (degrees, share) by which the telemetry is off; 5 and 0.05 are searched
OFF = [(5.0, 0.05), (0.0, 0.0), (3.3, -0.05), (-5.0, 0.03), (-1.7, -0.02)]
KNOWN = pytest.mark.parametrize(
    "known", [pytest.param(True, id="prior"), pytest.param(False, id="whole map", marks=pytest.mark.slow)]
)


@pytest.fixture(scope="module")
def flight():
    """A flight whose telemetry is the truth: what is off, the tests put there."""
    plan = plan_flight(3, town=drawn_town(1), frames=14, noise=EXACT, style=FlightStyle(peak_tilt_deg=6.9))
    return drawn_flight(plan)


@pytest.fixture(scope="module")
def site(flight):
    return site_of(flight.town)


@pytest.fixture(scope="module")
def matcher(site, flight):
    def build(town_site=site, **options):
        return SceneMatcher(town_site, flight.camera, "ncc", "cpu", MatcherOptions(ncc=NccOptions(**options)))

    return build


def near(truth, sigma_m=8.0):
    return Prior(lat_deg=truth.lat_deg, lon_deg=truth.lon_deg, sigma_m=sigma_m)


def stated(frame, turn_deg=0.0, share=0.0):
    heading = (frame.heading_deg + turn_deg) % 360.0
    return replace(frame, heading_deg=heading, height_agl_m=frame.height_agl_m * (1.0 + share), **REACH)


def turn_between(a_deg, b_deg):
    return abs((a_deg - b_deg + 180.0) % 360.0 - 180.0)


@pytest.mark.slow
@KNOWN
@pytest.mark.parametrize(("turn_deg", "share"), OFF)
def test_a_wrong_heading_and_height_are_put_right(matcher, site, flight, error_m, turn_deg, share, known):
    bank = matcher()
    for k in PLACES:
        frame, truth = flight.frames[k], flight.truth[k]
        fix = bank.locate(stated(frame, turn_deg, share), near(truth) if known else None)
        assert error_m(site, fix, truth) < 2.0
        assert turn_between(fix.attitude.heading_deg, truth.heading_deg) < 0.3
        height_m = fix.up_m - site.ground_at(np.array(fix.map_xy_px))
        assert height_m == pytest.approx(truth.height_agl_m, rel=0.005)


@pytest.mark.slow
@KNOWN
def test_a_frame_without_a_heading_is_found_all_around_or_refused(matcher, site, flight, error_m, known):
    bank = matcher()
    fixes = 0
    for k in PLACES:
        truth = flight.truth[k]
        result = bank.locate(replace(flight.frames[k], **ANY_HEADING), near(truth) if known else None)
        if isinstance(result, Fix):
            fixes += 1
            assert error_m(site, result, truth) < 2.0
            assert turn_between(result.attitude.heading_deg, truth.heading_deg) < 0.3
    assert fixes >= len(PLACES) - 1


@KNOWN
def test_an_attitude_that_was_not_searched_for_is_not_said_to_be_measured(matcher, flight, known):
    """Where the heading is given and trusted, a search of the whole map measures no attitude either."""
    frame, truth = flight.frames[PLACES[0]], flight.truth[PLACES[0]]
    prior = near(truth) if known else None
    fix = matcher().locate(frame, prior)
    assert fix.stage == "refined" or fix.attitude is None
    assert matcher(refine=False).locate(frame, prior).attitude is None


@pytest.mark.slow
@KNOWN
@pytest.mark.parametrize("telemetry", [REACH, ANY_HEADING], ids=["reach", "all around"])
def test_a_frame_of_another_town_is_refused(matcher, other_site, flight, telemetry, known):
    bank = matcher(other_site)
    prior = Prior(east_m=0.0, north_m=0.0, sigma_m=10.0) if known else None
    for k in PLACES:
        assert isinstance(bank.locate(replace(flight.frames[k], **telemetry), prior), NoFix)


@pytest.fixture
def looked_on(monkeypatch):
    """The levels on which all hypotheses were scored, in turn."""
    levels, real = [], hypothesis_search._from_level

    def noting(correlator, first, window, level, poses):
        levels.append(level)
        return real(correlator, first, window, level, poses)

    monkeypatch.setattr(hypothesis_search, "_from_level", noting)
    return levels


def test_a_place_beyond_doubt_is_that_of_a_thorough_search(matcher, site, flight, looked_on, monkeypatch):
    unknown = replace(flight.frames[5], **ANY_HEADING)
    quick = matcher().locate(unknown)
    levels = list(looked_on)
    monkeypatch.setattr(hypothesis_search, "is_beyond_doubt", lambda nats, risk: False)
    thorough = matcher().locate(unknown)
    assert len(levels) == 1
    assert looked_on == [*levels, *levels, levels[0] - 1]
    assert (quick.east_m, quick.north_m) == pytest.approx((thorough.east_m, thorough.north_m), abs=0.1)
    assert turn_between(quick.attitude.heading_deg, thorough.attitude.heading_deg) < 0.1


def test_a_place_in_doubt_is_searched_thoroughly(matcher, mirrored_site, flight, looked_on):
    result = matcher(mirrored_site).locate(replace(flight.frames[5], heading_sigma_deg=20.0 / SPREAD_SIGMAS))
    assert isinstance(result, NoFix)
    assert len(looked_on) == 2
    assert looked_on[0] == looked_on[1] + 1
