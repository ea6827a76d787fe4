"""How many transforms a flight plans: window sides are rounded up to lengths that are fast, which many share."""

from __future__ import annotations

import math

import torch

from engine.kernels import tensors
from engine.window import place_window, window_size_px


def adaptive_windows(count):
    """(H, W) of windows of a climb from 100 to 200 m on a curve at 15 m/s, one frame a second, 0.5 m a pixel."""
    for i in range(count):
        extent = 2.0 * (100.0 + 100.0 * i / count) * math.tan(math.radians(30.0)) / 0.5
        course = 2.0 * math.pi * i / count
        moved = (30.0 * math.sin(course), 30.0 * math.cos(course))
        window = place_window((2000.0, 2000.0), window_size_px((extent, extent), moved), (4000, 4000))
        assert window is not None
        yield window.height_px, window.width_px


def test_a_flight_of_many_window_sizes_plans_few_transforms(monkeypatch):
    plans, real = set(), torch.fft.rfft2

    def recorded(picture, s=None):
        plans.add(tuple(s or picture.shape[-2:]))
        return real(picture, s=s)

    monkeypatch.setattr(torch.fft, "rfft2", recorded)
    sizes = set(adaptive_windows(64))
    assert len(sizes) > 50
    template = torch.rand(1, 1, 48, 40, generator=torch.Generator().manual_seed(0))
    for height, width in sizes:
        products = tensors.correlate(torch.zeros(1, height, width), template)
        assert products.shape == (1, 1, height - 47, width - 39)
    assert len(plans) <= 24
