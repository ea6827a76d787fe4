"""Figures of merit against hand-made tracks."""

import json

import numpy as np
import pytest

from engine.geo import LocalFrame
from engine.values import Truth
from scenematch.files.track import TrackRow
from scenematch.report.metrics import Ground, errors_en_m, summarise

HERE = LocalFrame(32.79, 34.99)
SECOND_NS = 1_000_000_000


def truth_at(east_m, north_m, second, **known):
    lat, lon = HERE.geodetic_from_enu(east_m, north_m)
    return Truth(timestamp_ns=second * SECOND_NS, lat_deg=float(lat), lon_deg=float(lon), **known)


def fix_at(east_m, north_m, second, sigma_m=(1.0, 1.0), covariance_m2=0.0, **known):
    lat, lon = HERE.geodetic_from_enu(east_m, north_m)
    place = {"lat_deg": float(lat), "lon_deg": float(lon), "east_m": east_m, "north_m": north_m}
    sigmas = {"sigma_east_m": sigma_m[0], "sigma_north_m": sigma_m[1], "covariance_en_m2": covariance_m2}
    told = {"method": "ncc", "latency_ms": 10.0, "deadline_met": True} | known
    frame = {"timestamp_ns": second * SECOND_NS, "frame": f"{second:06d}.jpg", "status": "fix"}
    return TrackRow(**frame, **place, **sigmas, **told)


def refusal_at(second, reason="ambiguous", **known):
    stamp_ns = None if second is None else second * SECOND_NS
    return TrackRow(timestamp_ns=stamp_ns, frame=f"{second}.jpg", status="no_fix", reason=reason, **known)


def straight(seconds=10, **known):
    return [truth_at(7.0 * t, 3.0 * t, t, **known) for t in range(seconds)]


def test_counts_without_truth():
    rows = [
        fix_at(0, 0, 0, (1.0, 0.5), latency_ms=10.0),
        fix_at(0, 0, 1, (0.5, 2.0), latency_ms=20.0, method="sift"),
        fix_at(0, 0, 2, (3.0, 1.0), latency_ms=30.0, deadline_met=False),
        refusal_at(3, "late", latency_ms=140.0, deadline_met=False),
        refusal_at(4, "late"),
        refusal_at(5, "ambiguous"),
    ]
    assert summarise(rows) == {
        "frames": 6,
        "fixes": 3,
        "availability": 0.5,
        "status": {"fix": 3, "no_fix": 3},
        "reasons": {"late": 2, "ambiguous": 1},
        "method": "mixed",
        "methods": {"ncc": 2, "sift": 1},
        "latency_ms": {"p50": 25.0, "p95": pytest.approx(123.5), "p99": pytest.approx(136.7), "max": 140.0},
        "deadlines_missed": 2,
        "stated_sigma_median_m": 2.0,  # of the larger of each
        "stated_sigma_p95_m": pytest.approx(2.9),
    }


def test_an_empty_track_has_a_summary():
    summary = summarise([], straight())
    assert summary["frames"] == 0
    assert {summary[key] for key in ("availability", "rms_m", "method", "stated_sigma_median_m")} == {None}
    assert summary["latency_ms"] == {"p50": None, "p95": None, "p99": None, "max": None}


def test_errors_are_fix_less_truth_east_and_north():
    errors = errors_en_m([fix_at(8.0, 1.0, 1), refusal_at(2), fix_at(0.0, 0.0, 99)], straight(), HERE)
    np.testing.assert_allclose(errors.error_en_m[0], [1.0, -2.0], atol=1e-6)
    np.testing.assert_allclose(errors.truth_en_m[:2], [[7.0, 3.0], [14.0, 6.0]], atol=1e-6)
    assert np.isnan(errors.error_en_m[1:]).all()
    assert np.isnan(errors.truth_en_m[2]).all()


def test_accuracy_of_known_errors():
    offsets = [3.0, -4.0, 0.0, 12.0]
    rows = [fix_at(7.0 * t + offset, 3.0 * t, t) for t, offset in enumerate(offsets)]
    summary = summarise([*rows, refusal_at(5), fix_at(0, 0, 50)], straight(), frame=HERE)
    known = {"rms_m": np.sqrt(169 / 4), "median_m": 3.5, "r95_m": np.percentile([3, 4, 0, 12], 95), "max_m": 12}
    assert {name: summary[name] for name in known} == pytest.approx(known, abs=1e-5)
    assert (summary["scored_fixes"], summary["frames_without_truth"]) == (4, 1)
    assert summary["nees_mean"] == pytest.approx((9 + 16 + 144) / 4, rel=1e-5)
    assert (summary["wrong_over_10m"], summary["false_fixes"]) == (1, 1)


@pytest.mark.parametrize(
    ("error_en_m", "sigma_m", "covariance_m2", "wrong", "false"),
    [
        ((9.9, 0.0), (0.5, 0.5), 0.0, 0, 0),  # far outside its sigma, yet not 10 m
        ((12.0, 0.0), (5.0, 5.0), 0.0, 1, 0),  # 10 m off, and said so
        ((12.0, 0.0), (1.0, 9.0), 0.0, 1, 1),  # sure of east, which is where it is wrong
        ((0.0, 12.0), (1.0, 9.0), 0.0, 1, 0),  # unsure of north, which is where it is wrong
        ((10.0, 10.0), (8.0, 8.0), 60.0, 1, 0),  # along the ellipse
        ((10.0, -10.0), (8.0, 8.0), 60.0, 1, 1),  # across it
        ((12.0, 0.0), (None, None), None, 1, 1),  # a wrong fix that says nothing of itself
    ],
)
def test_a_false_fix_is_wrong_by_10_m_and_by_3_of_its_own_sigmas(error_en_m, sigma_m, covariance_m2, wrong, false):
    summary = summarise([fix_at(*error_en_m, 0, sigma_m, covariance_m2)], [truth_at(0, 0, 0)], frame=HERE)
    assert (summary["wrong_over_10m"], summary["false_fixes"]) == (wrong, false)


def test_the_origin_of_the_frame_does_not_matter():
    rows = [fix_at(7.0 * t + 2.0, 3.0 * t - 1.0, t) for t in range(8)]
    here, elsewhere = (summarise(rows, straight(), frame=frame) for frame in (HERE, LocalFrame(32.80, 35.0)))
    default = summarise(rows, straight())
    for key in ("rms_m", "r95_m", "nees_mean"):
        assert (elsewhere[key], default[key]) == pytest.approx((here[key], here[key]), rel=1e-4)


def test_height_is_compared_over_one_ground():
    rows = [fix_at(0, 0, 0, up_m=212.0), fix_at(7, 3, 1, up_m=208.0), fix_at(14, 6, 2)]
    above_ground = straight(height_agl_m=149.0)
    above_sea = straight(alt_amsl_m=199.0)
    for truth, ground in ((above_ground, Ground(60.0)), (above_sea, Ground(60.0, 50.0))):
        summary = summarise(rows, truth, frame=HERE, ground=ground)
        found_m = (summary["height_bias_m"], summary["height_rms_m"])
        assert found_m == pytest.approx((1.0, np.sqrt((9 + 1) / 2)))
    unknown = summarise(rows, above_sea, frame=HERE, ground=Ground(60.0))
    assert unknown["height_bias_m"] is unknown["height_rms_m"] is None


def test_a_summary_is_json_without_nan():
    rows = [fix_at(0, 0, 0, sigma_m=(0.0, 0.0)), refusal_at(None), fix_at(1, 1, 1, sigma_m=(None, None))]
    for truth in (None, straight(), [truth_at(0, 0, 999)]):
        assert json.loads(json.dumps(summarise(rows, truth), allow_nan=False))
