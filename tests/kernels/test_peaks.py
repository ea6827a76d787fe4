"""The highest places of a surface and the summits between them, on the host and on a device."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from engine.kernels.peaks import best_positions, find_peak, fit_peak
from engine.ncc_fft import match_template, prepare
from tests.support.fields import fields_of
from tests.support.pretended import DEVICE, pretended_device


def greedy(values, separation, count):
    """The highest place, then the highest that is far enough from all before, one by one."""
    order = np.argsort(-values, axis=None, kind="stable")
    places = []
    for y, x in zip(*np.unravel_index(order, values.shape), strict=True):
        if len(places) == count or values[y, x] <= -1.0:
            break
        if all(max(abs(x - u), abs(y - v)) > separation for u, v, _ in places):
            places.append((int(x), int(y), float(values[y, x])))
    return places


@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 25), st.integers(1, 25)),
    separation=st.integers(0, 6),
    count=st.integers(1, 9),
)
def test_best_places_are_taken_one_by_one(seed, size, separation, count):
    values = np.random.default_rng(seed).uniform(-0.9, 0.9, size).astype(np.float32)
    before = values.copy()
    assert best_positions(torch.from_numpy(values), separation, count) == greedy(values, separation, count)
    np.testing.assert_array_equal(values, before)


def test_places_that_do_not_count_are_no_places():
    assert best_positions(torch.full((7, 9), -1.0), 2, 3) == []


# Summits


def patch_of(polynomial, n):
    y, x = np.mgrid[:n, :n] - n // 2
    return polynomial(x.astype(float), y.astype(float))


@given(
    at=st.tuples(st.floats(-0.49, 0.49), st.floats(-0.49, 0.49)),
    bend=st.tuples(st.floats(-1.0, -0.01), st.floats(-0.9, 0.9), st.floats(-1.0, -0.01)),
    n=st.sampled_from([3, 5]),
)
def test_the_summit_of_a_paraboloid_is_exact(at, bend, n):
    a, share, b = bend
    c = share * np.sqrt(a * b)
    x0, y0 = at

    def paraboloid(x, y):
        return 0.7 + 0.5 * (a * (x - x0) ** 2 + 2 * c * (x - x0) * (y - y0) + b * (y - y0) ** 2)

    dx, dy, curvature = fit_peak(patch_of(paraboloid, n))
    assert (dx, dy) == (pytest.approx(x0, abs=1e-6), pytest.approx(y0, abs=1e-6))
    np.testing.assert_allclose(curvature, [[a, c], [c, b]], atol=1e-9)


@given(
    at=st.tuples(st.floats(-0.45, 0.45), st.floats(-0.45, 0.45)),
    sharp=st.tuples(st.floats(0.0, 0.02), st.floats(0.0, 0.02)),
    skew=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)),
)
def test_the_summit_of_a_quartic_is_exact(at, sharp, skew):
    """A polynomial of degree 4 in each axis about a summit inside: all of it is in the family."""
    (x0, y0), (p, q), (s, t) = at, sharp, skew

    def along(u, u0, k, m):
        # u-derivative is (u - u0) (-0.2 + m u + 4 k u^2): it vanishes at u0 alone within reach
        return -0.1 * u * u + 0.2 * u0 * u + m * (u**3 / 3 - u0 * u * u / 2) + k * (u**4 - 4 * u0 * u**3 / 3)

    def quartic(x, y):
        return 0.8 + along(x, x0, p, s) + along(y, y0, q, t)

    dx, dy, curvature = fit_peak(patch_of(quartic, 5))
    assert (dx, dy) == (pytest.approx(x0, abs=1e-4), pytest.approx(y0, abs=1e-4))
    assert np.linalg.eigvalsh(curvature).max() < 0


@pytest.mark.parametrize("n", [3, 5])
@given(seed=st.integers(0, 2**32 - 1))
def test_an_offset_is_finite_and_at_most_half_a_pixel(n, seed):
    patch = np.random.default_rng(seed).uniform(-1.0, 1.0, (n, n))
    dx, dy, curvature = fit_peak(patch)
    assert max(abs(dx), abs(dy)) <= 0.5
    assert np.isfinite(curvature).all()
    turned = fit_peak(np.ascontiguousarray(patch.T))
    assert turned[:2] == (pytest.approx(dy, abs=1e-6), pytest.approx(dx, abs=1e-6))


@pytest.mark.parametrize("n", [3, 5])
def test_level_ground_ridges_and_bowls_have_no_summit(n):
    for shape in (lambda x, y: 0 * x, lambda x, y: x * x + y * y, lambda x, y: x * x - y * y):
        assert fit_peak(patch_of(shape, n))[:2] == (0.0, 0.0)


# On a device


def draw(size):
    """A view into a larger buffer of NaN, as a transform's is, with many equal scores."""
    rough = torch.randn(1, 1, *size, generator=torch.Generator().manual_seed(sum(size)))
    smooth = torch.nn.functional.avg_pool2d(rough, 3, stride=1, padding=1)[0, 0].clamp(-1.0, 1.0)
    wide = torch.full((size[0] + 2, size[1] + 5), np.nan)
    wide[: size[0], : size[1]] = torch.round(32.0 * smooth) / 64.0
    return wide


@pytest.mark.parametrize("exclusion_px", [0.0, np.sqrt(2.0), 5.0, 5.5, 1e5])
@pytest.mark.parametrize(
    "size",
    [
        (88, 82),  # a peak with 5 x 5 places about it
        (8, 8),  # 3 x 3
        (4, 2),  # none: on the border
        (1, 500),  # one row
        (500, 1),  # one column
        (1, 1),  # one place
    ],
    ids=str,
)
def test_the_peak_on_a_device_is_that_on_the_host(size, exclusion_px):
    wide, part = draw(size), np.s_[: size[0], : size[1]]
    expected = find_peak(wide[part], exclusion_px=exclusion_px)
    with pretended_device():
        found = find_peak(wide.to(DEVICE)[part], exclusion_px=exclusion_px)
    for one, other in zip(fields_of(found), fields_of(expected), strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_peak_of_a_window_without_texture_is_finite():
    with pretended_device():
        search, template = prepare(torch.zeros(60, 70).to(DEVICE)), torch.rand(20, 30).to(DEVICE)
        found = match_template(search, template, exclusion_px=3.0)
    assert (found.x, found.y, found.score, found.second_score) == (0.0, 0.0, 0.0, 0.0)
