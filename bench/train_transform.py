"""Train the transform of :mod:`bench.transform` from nothing: ``python -m bench.train_transform [--steps N]``.

Pairs of one place: years of the half of the places that is for fitting (:mod:`bench.accuracy.years`), and towns in
two lights and seasons. A patch of one is correlated with the ground about its place in the other, and with the
other places of the batch; the loss is the cross entropy of the true shift among all of these.
"""

from __future__ import annotations

import argparse
import time
from itertools import permutations
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench import ROOT
from bench.accuracy.years import YEARS, opened, places, shift, vintages
from bench.transform import SHAPES, Weights, forward
from engine.kernels.scores import enhance
from engine.runtime.threads import set_threads
from engine.values import Window
from scenematch.simulator import build_town

Gray = NDArray[np.uint8]
Pair = tuple[Gray, Gray, NDArray[np.float64]]  # two pictures of one place, and the shift of the second

TOWNS = (21, 23, 25)  # of those that everything is fitted on
LIGHTS = (("noon", "evening"), ("noon", "winter"), ("morning", "autumn"))
SOURCE_SHARES = {"cities": 0.55, "farmland": 0.2, "towns": 0.25}
BATCH, PATCH_PX, SLACK_PX, BORDER_PX = 8, 96, 32, 12
TEMPERATURE, WITHIN_PX = 0.04, 1.5
RATE = 3e-3


def main() -> None:
    """Train, and store the weights."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=700)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=ROOT / ".benchmarks" / "transform.npz")
    options = parser.parse_args()
    set_threads(1)
    torch.manual_seed(options.seed)
    weights = trained(sources(), options.steps, np.random.default_rng(options.seed))
    np.savez_compressed(
        options.out, **{name: w.detach().numpy().astype(np.float16) for name, w in weights.items()}
    )


def trained(pairs: dict[str, list[Pair]], steps: int, rng: np.random.Generator) -> Weights:
    """Weights after a number of steps of Adam, its rate falling as a cosine."""
    weights = initial()
    adam = torch.optim.Adam(weights.values(), RATE)
    rates = torch.optim.lr_scheduler.OneCycleLR(adam, RATE, total_steps=steps, pct_start=0.1)
    running, start = 0.0, time.monotonic()
    for step in range(steps):
        patches, grounds = batch(pairs, rng)
        adam.zero_grad()
        found = loss(forward(weights, patches), forward(weights, grounds))
        found.backward()
        torch.nn.utils.clip_grad_norm_(weights.values(), 1.0)
        adam.step()
        rates.step()
        running += (found.item() - running) / min(step + 1, 50)
        if step % 50 == 0:
            print(f"step {step}, loss {running:.3f}, {time.monotonic() - start:.0f} s", flush=True)
    return weights


def initial() -> Weights:
    """Random weights of the size that keeps a signal's variance."""
    weights: Weights = {}
    for name, shape in SHAPES.items():
        weights[name] = (torch.randn(shape) * (2.0 / np.prod(shape[1:])) ** 0.5).requires_grad_()
        weights[f"{name}.bias"] = torch.zeros(shape[0], requires_grad=True)
    return weights


def loss(patches: Tensor, grounds: Tensor) -> Tensor:
    """Cross entropy of the true place of each patch among all places of all grounds of the batch."""
    inner = slice(BORDER_PX, -BORDER_PX)
    scores = correlated(patches[:, 0, inner, inner], grounds[:, 0, inner, inner]) / TEMPERATURE
    middle = scores.shape[-1] // 2
    steps = torch.arange(scores.shape[-1]) - middle
    near = (steps[:, None] ** 2 + steps**2) <= WITHIN_PX**2
    own = scores.diagonal().permute(2, 0, 1)[:, near]
    return (scores.flatten(1).logsumexp(1) - own.logsumexp(1)).mean()


def correlated(patches: Tensor, grounds: Tensor) -> Tensor:
    """Zero-mean NCC (B, B, n, n) of every patch (B, h, h) with every ground (B, H, H)."""
    size, side = patches.shape[-1], grounds.shape[-1]
    patches = patches - patches.mean((1, 2), keepdim=True)
    patches = patches / patches.square().sum((1, 2), keepdim=True).add(1e-6).sqrt()
    grounds = grounds - grounds.mean((1, 2), keepdim=True)
    n = side - size + 1
    spectra = torch.fft.rfft2(grounds)[None] * torch.fft.rfft2(patches, s=(side, side)).conj()[:, None]
    products = torch.fft.irfft2(spectra, s=(side, side))[..., :n, :n]
    sums, squares = (torch.nn.functional.avg_pool2d(x[:, None], size, 1)[:, 0] for x in (grounds, grounds**2))
    return products / ((squares - sums**2).clamp_min(1e-6) * size**2).sqrt()[None]


def batch(pairs: dict[str, list[Pair]], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Patches (B, 1, h, h) of one picture of places, and grounds (B, 1, H, H) about them in the other."""
    names = rng.choice(list(SOURCE_SHARES), BATCH, p=list(SOURCE_SHARES.values()))
    drawn = [_sample(pairs[name][int(rng.integers(len(pairs[name])))], rng) for name in names]
    return tuple(torch.from_numpy(np.stack(part))[:, None] for part in zip(*drawn, strict=True))  # type: ignore[return-value]


def _sample(pair: Pair, rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A patch with telemetry's errors, and the ground about it, turned and scaled at random, both normalised."""
    seen, mapped, shift_px = pair
    turn_deg, scale = rng.uniform(0.0, 360.0), rng.uniform(0.8, 1.3)
    side = PATCH_PX + 2 * BORDER_PX
    reach = 0.75 * side / scale
    low, high = reach, np.array(seen.shape[::-1]) - reach
    middle = rng.uniform(np.minimum(low, high), np.maximum(low, high))
    patch = _cut(seen, middle, turn_deg + rng.normal(0.0, 0.7), scale * rng.normal(1.0, 0.01), side)
    ground = _cut(mapped, middle + shift_px, turn_deg, scale, side + 2 * SLACK_PX)
    gain, offset = rng.uniform(0.6, 1.2), rng.uniform(-20.0, 20.0)
    if rng.random() < 0.3:
        patch = cv2.GaussianBlur(patch, (0, 0), rng.uniform(0.4, 1.2))
    patch = np.clip(patch * gain + offset + rng.normal(0.0, rng.uniform(0.0, 4.0), patch.shape), 0, 255)
    return enhance(patch.astype(np.uint8)), enhance(ground)


def _cut(gray: Gray, middle: NDArray[np.float64], turn_deg: float, scale: float, side: int) -> Gray:
    matrix = cv2.getRotationMatrix2D(tuple(map(float, middle)), turn_deg, scale)
    matrix[:, 2] += side // 2 - middle
    return np.asarray(cv2.warpAffine(gray, matrix, (side, side), borderMode=cv2.BORDER_REFLECT_101), np.uint8)


def sources() -> dict[str, list[Pair]]:
    """What is trained on, by its name."""
    cities = [
        (gray("naip-cities", place, a), gray("naip-cities", place, b), shift(place, a, b))
        for place in places("fit") if "_m" not in place for a, b in permutations(YEARS, 2)
    ]  # fmt: skip
    grays = {year: gray("naip", "naip", year) for year in vintages()}
    farmland = [(grays[a], grays[b], np.zeros(2)) for a, b in permutations(grays, 2)]
    towns = []
    for seed, (a, b) in zip(TOWNS, LIGHTS, strict=True):
        one, two = (_town(seed, light) for light in (a, b))
        towns += [(one, two, np.zeros(2)), (two, one, np.zeros(2))]
    return {"cities": cities, "farmland": farmland, "towns": towns}


def gray(source: str, place: str, year: str) -> Gray:
    """The whole map of the half for fitting, in a year."""
    site = opened(source, "fit", place, year)
    return site.gray(Window(0, 0, site.width_px, site.height_px))


def _town(seed: int, light: str) -> Gray:
    return np.asarray(cv2.cvtColor(build_town(seed, map_condition=light).ortho, cv2.COLOR_RGB2GRAY), np.uint8)


if __name__ == "__main__":
    main()
