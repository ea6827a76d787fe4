"""Figures of merit against hand-made tracks, and that plots are drawn where and as they should be."""

import json
import math
import sys
from itertools import pairwise

import numpy as np
import pytest

from engine.geo import LocalFrame
from engine.values import Truth
from scenematch.files.frames import read_image
from scenematch.files.track import TrackRow
from scenematch.report.figures import draw_figures, plain_log_ticks
from scenematch.report.metrics import Ground, errors_en_m, summarise

HERE = LocalFrame(32.79, 34.99)
SECOND_NS = 1_000_000_000


def truth_at(east_m, north_m, second, **known):
    lat, lon = HERE.geodetic_from_enu(east_m, north_m)
    return Truth(timestamp_ns=second * SECOND_NS, lat_deg=float(lat), lon_deg=float(lon), **known)


def fix_at(east_m, north_m, second, sigma_m=(1.0, 1.0), covariance_m2=0.0, **known):
    lat, lon = HERE.geodetic_from_enu(east_m, north_m)
    return TrackRow(
        timestamp_ns=second * SECOND_NS,
        frame=f"{second:06d}.jpg",
        status="fix",
        lat_deg=float(lat),
        lon_deg=float(lon),
        east_m=east_m,
        north_m=north_m,
        sigma_east_m=sigma_m[0],
        sigma_north_m=sigma_m[1],
        covariance_en_m2=covariance_m2,
        **({"method": "ncc", "latency_ms": 10.0, "deadline_met": True} | known),
    )


def refusal_at(second, reason="ambiguous", **known):
    stamp_ns = None if second is None else second * SECOND_NS
    return TrackRow(timestamp_ns=stamp_ns, frame=f"{second}.jpg", status="no_fix", reason=reason, **known)


def straight(seconds=10, **known):
    return [truth_at(7.0 * t, 3.0 * t, t, **known) for t in range(seconds)]


def test_counts_without_truth():
    rows = [
        fix_at(0, 0, 0, latency_ms=10.0),
        fix_at(0, 0, 1, latency_ms=20.0, method="sift"),
        fix_at(0, 0, 2, latency_ms=30.0, deadline_met=False),
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
        "stated_sigma_median_m": 1.0,
        "stated_sigma_p95_m": 1.0,
    }


def test_an_empty_track_has_a_summary():
    summary = summarise([], straight())
    assert (summary["frames"], summary["availability"], summary["rms_m"], summary["method"]) == (
        0,
        None,
        None,
        None,
    )
    assert summary["latency_ms"] == {"p50": None, "p95": None, "p99": None, "max": None}


def test_errors_are_fix_less_truth_east_and_north():
    errors = errors_en_m([fix_at(8.0, 1.0, 1), refusal_at(2), fix_at(0.0, 0.0, 99)], straight(), HERE)
    np.testing.assert_allclose(errors.error_en_m[0], [1.0, -2.0], atol=1e-6)
    np.testing.assert_allclose(errors.truth_en_m[:2], [[7.0, 3.0], [14.0, 6.0]], atol=1e-6)
    assert np.isnan(errors.error_en_m[1:]).all()
    assert np.isnan(errors.truth_en_m[2]).all()


def test_accuracy_of_known_errors():
    offsets = [3.0, -4.0, 0.0, 12.0]
    rows = [fix_at(7.0 * t + offset, 3.0 * t, t) for t, offset in enumerate(offsets)] + [
        refusal_at(5),
        fix_at(0, 0, 50),
    ]
    summary = summarise(rows, straight(), frame=HERE)
    assert summary["rms_m"] == pytest.approx(math.sqrt((9 + 16 + 0 + 144) / 4), abs=1e-5)
    assert summary["median_m"] == pytest.approx(3.5, abs=1e-5)
    assert summary["r95_m"] == pytest.approx(np.percentile([3, 4, 0, 12], 95), abs=1e-5)
    assert summary["max_m"] == pytest.approx(12.0, abs=1e-5)
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


def test_nees_of_a_consistent_covariance_is_2():
    rng = np.random.default_rng(8)
    root = np.array([[2.0, 0.0], [0.9, 0.6]])
    covariance = root @ root.T
    sigma = np.sqrt(np.diag(covariance))
    rows = [fix_at(*(root @ rng.normal(size=2)), t, sigma, covariance[0, 1]) for t in range(1500)]
    truth = [truth_at(0, 0, t) for t in range(1500)]
    assert summarise(rows, truth, frame=HERE)["nees_mean"] == pytest.approx(2.0, abs=0.15)


def test_the_origin_of_the_frame_does_not_matter():
    rows = [fix_at(7.0 * t + 2.0, 3.0 * t - 1.0, t) for t in range(8)]
    here, elsewhere = (summarise(rows, straight(), frame=frame) for frame in (HERE, LocalFrame(32.80, 35.0)))
    default = summarise(rows, straight())
    for key in ("rms_m", "r95_m", "nees_mean"):
        assert here[key] == pytest.approx(elsewhere[key], rel=1e-4)
        assert here[key] == pytest.approx(default[key], rel=1e-4)


def test_height_is_compared_over_one_ground():
    rows = [fix_at(0, 0, 0, up_m=212.0), fix_at(7, 3, 1, up_m=208.0), fix_at(14, 6, 2)]
    above_ground = straight(height_agl_m=149.0)
    above_sea = straight(alt_amsl_m=199.0)
    for truth, ground in ((above_ground, Ground(60.0)), (above_sea, Ground(60.0, 50.0))):
        summary = summarise(rows, truth, frame=HERE, ground=ground)
        assert summary["height_bias_m"] == pytest.approx(1.0)
        assert summary["height_rms_m"] == pytest.approx(math.sqrt((9 + 1) / 2))
    unknown = summarise(rows, above_sea, frame=HERE, ground=Ground(60.0))
    assert unknown["height_bias_m"] is unknown["height_rms_m"] is None


def test_a_summary_is_json_without_nan():
    rows = [fix_at(0, 0, 0, sigma_m=(0.0, 0.0)), refusal_at(None), fix_at(1, 1, 1, sigma_m=(None, None))]
    for truth in (None, straight(), [truth_at(0, 0, 999)]):
        assert json.loads(json.dumps(summarise(rows, truth), allow_nan=False))


# -------------------------------------------------------------------------------------------------- figures


class TiltedMap:
    """A map of 200 x 160 pixels of 1 m whose columns run 30 degrees off east; one pixel is white."""

    width_px, height_px, levels, frame = 200, 160, 3, HERE
    bright_xy = (140, 40)

    def __init__(self):
        turn = math.radians(30.0)
        self._matrix = np.array([[math.cos(turn), math.sin(turn)], [math.sin(turn), -math.cos(turn)]])
        self._gray = np.full((160, 200), 60, np.uint8)
        self._gray[35:46, 135:146] = 255
        self._gray[:20, :20] = 120

    def level_shape(self, level):
        return self.height_px >> level, self.width_px >> level

    def gray(self, window, level=0):
        step = 1 << level
        level_image = self._gray[::step, ::step]
        crop = level_image[window.y0 : window.y0 + window.height_px, window.x0 : window.x0 + window.width_px]
        assert crop.shape == (window.height_px, window.width_px)
        return crop.copy()

    def valid(self, window, level=0):
        return np.ones((window.height_px, window.width_px), bool)

    def enu_from_pixel(self, xy_px):
        return (np.asarray(xy_px, float) - [100, 80]) @ self._matrix.T

    def pixel_from_enu(self, en_m):
        return np.asarray(en_m, float) @ np.linalg.inv(self._matrix).T + [100, 80]


def flight(height=True):
    truth = [truth_at(-50.0 + 5.0 * t, 20.0 * math.sin(t / 3), t, height_agl_m=150.0) for t in range(20)]
    rows = []
    for t in range(20):
        if t in (4, 5, 11):
            rows.append(refusal_at(t))
        else:
            known = {"up_m": 150.0 + math.sin(t)} if height else {}
            far = 80.0 if t == 7 else 0.0
            rows.append(fix_at(-50.0 + 5.0 * t + math.cos(t) + far, 20.0 * math.sin(t / 3), t, **known))
    return rows, truth


def names(paths):
    return [path.name for path in paths]


def test_all_plots_are_drawn_without_global_state(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)  # importing it would fail
    rows, truth = flight()
    written = draw_figures(tmp_path / "new", rows, truth, site=TiltedMap(), title="A flight")
    assert names(written) == ["path.png", "position.png", "height.png", "error.png"]
    assert all(min(read_image(path).shape[:2]) > 400 for path in written)


def test_only_plots_with_something_to_show_are_drawn(tmp_path):
    rows, truth = flight(height=False)
    assert names(draw_figures(tmp_path, rows, truth)) == ["path.png", "position.png", "error.png"]
    assert names(draw_figures(tmp_path, rows, None)) == ["path.png", "position.png"]
    refused = [refusal_at(t) for t in range(5)]
    assert names(draw_figures(tmp_path, refused, truth)) == ["path.png", "position.png"]
    assert draw_figures(tmp_path, refused, None) == []
    assert draw_figures(tmp_path, [], None) == []


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 1])
def test_short_tracks_and_missing_stamps_are_drawn(tmp_path, count):
    rows, truth = flight()
    assert draw_figures(tmp_path, rows[:count], truth, site=TiltedMap())
    rows[1] = refusal_at(None)
    assert draw_figures(tmp_path, rows, truth)


@pytest.mark.slow
def test_a_path_off_the_map_is_drawn_on_blank_ground(tmp_path):
    rows = [fix_at(5000.0 + t, 5000.0, t) for t in range(3)]
    assert draw_figures(tmp_path, rows, None, site=TiltedMap())


def test_the_map_lies_where_its_pixels_are(tmp_path, monkeypatch):
    """The white patch of a turned map must come out at its own east and north, not mirrored or shifted."""
    from matplotlib.figure import Figure

    figures, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (figures.append(self), save(self, *a, **k))[1])
    site = TiltedMap()
    rows = [fix_at(e, n, t) for t, (e, n) in enumerate([(-60, -50), (60, 50)])]
    path = draw_figures(tmp_path, rows, None, site=site)[0]
    image = read_image(path).mean(axis=2)
    axes = figures[0].axes[0]
    x, y = axes.transData.transform(site.enu_from_pixel(site.bright_xy)) * 130 / figures[0].dpi
    patch = image[round(image.shape[0] - 1 - y) - 3 :, round(x) - 3 :][:7, :7]
    assert (patch > 250).all()
    edge = (
        axes.transData.transform(site.enu_from_pixel([site.bright_xy[0] + 8, site.bright_xy[1]]))
        * 130
        / figures[0].dpi
    )
    assert image[round(image.shape[0] - 1 - edge[1]), round(edge[0])] < 200


@pytest.mark.parametrize("span", [(0.9, 1.8), (0.0015, 2.0), (0.2, 19.0)])
def test_labels_of_a_logarithmic_axis_are_plain_and_do_not_overlap(span):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.4, 3.0), layout="constrained")
    ax = figure.add_subplot()
    ax.plot(span, (0.0, 1.0))
    ax.set_xscale("log")
    plain_log_ticks(ax.xaxis)
    FigureCanvasAgg(figure).draw()
    inside = [t for t in ax.xaxis.get_ticklabels(which="both") if t.get_text() and _within(t, ax)]
    boxes = sorted(label.get_window_extent().extents[[0, 2]].tolist() for label in inside)
    assert boxes
    assert all(right < left for (_, right), (left, _) in pairwise(boxes))
    assert all(float(label.get_text()) == pytest.approx(label.get_position()[0]) for label in inside)


def _within(label, ax):
    low, high = ax.get_xlim()
    return low <= label.get_position()[0] <= high


@pytest.mark.slow
def test_the_heading_of_a_narrow_path_is_not_cut_off(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    drawn = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **o: (save(self, path, **o), drawn.append(self)))
    truth = [truth_at(0.5 * t, 30.0 * t, t) for t in range(10)]
    rows = [fix_at(0.5 * t, 30.0 * t, t) for t in range(10)]
    draw_figures(tmp_path, rows, truth, title="ncc (engine profile)")
    for figure in drawn:
        box = figure.get_tightbbox()
        assert box.x0 >= 0
        assert box.x1 <= figure.get_figwidth()
