"""The fused peak against its plain torch twin, in Triton's interpreter and on CUDA; peaks found on a device.

The checks named ``check_*`` run where the fixture ``on`` says. Triton reads TRITON_INTERPRET when it is imported:
the interpreter lives in a process of its own.
"""

from __future__ import annotations

import dataclasses
import math
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from multiprocessing import get_context

import numpy as np
import pytest
import torch

from engine.errors import ShapeError
from engine.kernels import eager
from engine.kernels import ncc as kernels
from engine.kernels.peaks import find_peak
from engine.ncc_fft import Search, match_template, match_templates, prepare, surface

SHAPES = [
    (1, 1, 1),
    (2, 1, 500),  # one row
    (2, 500, 1),  # one column
    (3, 63, 65),  # odd: the last block is not full
    (1, 64, 32),  # exactly one block
    (2, 41, 100),  # two full blocks and four places
]
needs_triton = pytest.mark.skipif(
    find_spec("triton") is None, reason="triton is not installed: pip install triton"
)


def in_process(interpret, tmp_path):
    """A process that imports Triton with the interpreter or without, and this one's environment as it was."""
    pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRITON_INTERPRET", "1" if interpret else "0")
        patch.setenv("TRITON_CACHE_DIR", str(tmp_path))
        pool.submit(torch.set_num_threads, 1).result()
    return pool


@pytest.fixture(scope="module", params=[pytest.param("interpreter", marks=pytest.mark.slow), "cuda"])
def on(request, tmp_path_factory):
    """Runs a check, a function of this module, with Triton; its first argument is the device."""
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("there is no CUDA device")
        yield lambda check, *args: check("cuda", *args)
    else:
        with in_process(True, tmp_path_factory.mktemp("triton")) as pool:
            yield lambda check, *args: pool.submit(check, "cpu", *args).result()


def poisoned(*args, **kwargs):
    """Memory as if fresh: an unwritten cell shows."""
    return torch.full(*args, math.nan if kwargs["dtype"].is_floating_point else 2**62, **kwargs)


def whole_surface(search, template):
    """The surface by tensor ops, as a device has it."""
    return surface(of_tensors(search), template[None])[0]


def of_tensors(search):
    """A map that is prepared as arrays, as the tensors that a device has."""
    image = torch.as_tensor(search.image)
    return Search(image, sums=eager.integrals(image))


def on_device(search, template, exclusion_px):
    """The peak as a device finds it, wherever the tensors are."""
    return match_template(of_tensors(search), template, exclusion_px=exclusion_px)


def fused(name, *args):
    """A function of the kernel's, on poisoned memory."""
    from engine.kernels import triton_peak

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "empty", poisoned)
        return getattr(triton_peak, name)(*args)


def draw(device, shape):
    """Views into larger buffers of NaN, as a transform's are, with many equal scores and some beyond 1."""
    rng = torch.Generator().manual_seed(sum(shape))
    t, height, width = shape
    products = torch.full((t, height + 2, width + 5), math.nan)[:, :height, :width]
    products.copy_(torch.randint(-40, 41, shape, generator=rng) / 32.0)
    norms = torch.full((height, width + 3), math.nan)[:, :width]
    norms.copy_(torch.randint(0, 5, (height, width), generator=rng) / 4.0)
    return products.to(device), norms.to(device)


def scores_of(products, norms):
    return np.clip(products.cpu().numpy() * norms.cpu().numpy(), -1.0, 1.0)


def check_peak(device, shape):
    given = draw(device, shape)
    best, places = fused("peak", *given)
    assert (best.dtype, places.dtype) == (torch.float32, torch.int64)
    flat = scores_of(*given).reshape(shape[0], -1)
    np.testing.assert_array_equal(places.cpu(), flat.argmax(axis=1))
    np.testing.assert_array_equal(best.cpu(), flat.max(axis=1))
    for mine, twin in zip((best, places), eager.peak(*given), strict=True):
        torch.testing.assert_close(mine, twin, rtol=0, atol=0)


def check_rival(device, shape):
    given = draw(device, shape)
    scores = scores_of(*given)
    height, width = shape[1:]
    rows, columns = np.ogrid[:height, :width]
    for place in {0, width - 1, height * width // 2, height * width - 1}:
        distance = (rows - place // width) ** 2 + (columns - place % width) ** 2
        for radius_squared in (0, 2, 25, 1000, 10**10):
            winner = torch.tensor([place], device=device).expand(shape[0])
            best = fused("rival", *given, winner, radius_squared)
            outside = np.where(distance > radius_squared, scores, np.float32(-1.0))
            np.testing.assert_array_equal(best.cpu(), outside.max(axis=(1, 2)))
            twin = eager.rival(*given, winner, radius_squared)
            torch.testing.assert_close(best, twin, rtol=0, atol=0)


def check_ties(device):
    products, norms = torch.zeros(3, 70, 90, device=device), torch.ones(70, 90, device=device)
    products[0, 50, 7] = products[0, 50, 8] = products[0, 69, 89] = 0.5
    products[1] = 7.0  # all of them 1 once they are cut off
    products[2] = -7.0
    best, places = fused("peak", products, norms)
    assert best.tolist() == [0.5, 1.0, -1.0]
    assert places.tolist() == [50 * 90 + 7, 0, 0]
    assert fused("rival", products, norms, places, 10**10).tolist() == [-1.0] * 3


def check_nan(device):
    """NaN never wins, and infinities are cut off, by either."""
    products, norms = draw(device, (3, 63, 65))
    products[0, 5, 6:9], products[1], products[2, 62, 64] = math.nan, math.nan, math.inf
    norms[62, 64] = 1.0
    expected = torch.nan_to_num(products * norms, nan=-1.0).clamp(-1.0, 1.0).flatten(1).max(dim=1)
    best, places = fused("peak", products, norms)
    torch.testing.assert_close(best, expected.values, rtol=0, atol=0)
    assert (best[1].item(), places[1].item(), best[2].item()) == (-1.0, 0, 1.0)
    for name, more in (("peak", ()), ("rival", (places, 30))):
        mine, twin = fused(name, products, norms, *more), getattr(eager, name)(products, norms, *more)
        torch.testing.assert_close(mine, twin, rtol=0, atol=0)


def check_batch(device):
    """Every template with norms and a winner of its own, as one by one."""
    drawn = [draw(device, (1, 41, 53)) for _ in range(4)]
    products = torch.cat([p.roll(i, 1) for i, (p, _) in enumerate(drawn)])
    norms = torch.stack([n.roll(2 * i, 0) for i, (_, n) in enumerate(drawn)])
    best, places = fused("peak", products, norms)
    second = fused("rival", products, norms, places, 25)
    for i in range(4):
        one = products[i : i + 1], norms[i]
        torch.testing.assert_close(fused("peak", *one), (best[i : i + 1], places[i : i + 1]), rtol=0, atol=0)
        alone = eager.rival(*one, places[i : i + 1], 25)
        torch.testing.assert_close(alone, second[i : i + 1], rtol=0, atol=0)


def check_match(device, size, model):
    search, template = picture(size, model, device)
    expected = find_peak(whole_surface(search, template), exclusion_px=5.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "_by_triton", lambda tensor: True)
        assert_same(on_device(search, template, 5.0), expected)
    if device == "cuda":
        assert_same(match_template(search, template, exclusion_px=5.0), expected)


@pytest.mark.slow
@needs_triton
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_the_peak_is_that_of_plain_torch(on, shape):
    on(check_peak, shape)


@needs_triton
@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 77), (2, 63, 50)], ids=str)
def test_the_rival_is_that_of_plain_torch(on, shape):
    on(check_rival, shape)


@needs_triton
def test_of_equal_scores_the_first_is_the_peak(on):
    on(check_ties)


@needs_triton
def test_nan_never_wins(on):
    on(check_nan)


@needs_triton
def test_a_batch_is_matched_as_its_templates_one_by_one(on):
    on(check_batch)


@needs_triton
@pytest.mark.parametrize(("size", "model"), [((120, 97), (31, 40)), ((31, 90), (31, 40)), ((9, 9), (9, 9))])
def test_a_match_by_the_fused_kernel_is_that_of_the_whole_surface(on, size, model):
    on(check_match, size, model)


def compile_for(capability):
    """Sizes of the machine code of the launches with and without winner."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from engine.kernels import triton_peak

    pointers = {"products": "*fp32", "inverse_norms": "*fp32", "best": "*fp32", "indices": "*i64"}
    optional = {"winner": "*i64"}
    sizes = dict.fromkeys(triton_peak._SIZES, "i64") | {"width": "i32"}
    found = []
    for given in ({}, optional):
        constants = {"BLOCK": triton_peak._BLOCK} | {name: None for name in optional if name not in given}
        types = pointers | given | sizes | dict.fromkeys(constants, "constexpr")
        kernel = triton_peak._block_peaks
        source = ASTSource(kernel, {name: types[name] for name in kernel.arg_names}, constants)
        target = GPUTarget("cuda", capability, 32)
        compiled = triton.compile(source, target=target, options={"enable_fp_fusion": False})
        found.append(len(compiled.asm["cubin"]))
    return found


@needs_triton
@pytest.mark.slow
def test_the_kernel_compiles_without_a_gpu(tmp_path):
    """The interpreter takes what the compiler refuses."""
    with in_process(False, tmp_path) as pool:
        for capability in (80, 90):
            assert min(pool.submit(compile_for, capability).result()) > 0


def picture(size, model, device="cpu"):
    """A smooth picture, and a template of it that lies at a fifth of the way."""
    rng = torch.Generator().manual_seed(size[0])
    rough = torch.randn(1, 1, *size, generator=rng)
    image = torch.nn.functional.avg_pool2d(rough, 3, stride=1, padding=1)[0, 0]
    y, x = ((n - m) // 5 for n, m in zip(size, model, strict=True))
    template = image[y : y + model[0], x : x + model[1]] + 0.05 * torch.randn(*model, generator=rng)
    return prepare(image.to(device)), template.to(device)


def assert_same(found, expected):
    for field in dataclasses.fields(expected):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name), field.name)


@pytest.mark.parametrize("exclusion_px", [0.0, math.sqrt(2.0), 5.0, 5.5, 1000.0])
@pytest.mark.parametrize(
    ("size", "model"),
    [
        ((150, 131), (63, 50)),  # a peak with 5 x 5 places about it
        ((70, 71), (63, 64)),  # 3 x 3
        ((66, 64), (63, 63)),  # none: on the border
        ((63, 100), (63, 50)),  # one row
        ((40, 40), (40, 40)),  # one place
    ],
)
def test_the_peak_on_a_device_is_that_of_the_whole_surface(size, model, exclusion_px):
    """On the CPU, by the plain torch twins."""
    search, template = picture(size, model)
    found = on_device(search, template, exclusion_px)
    assert_same(found, find_peak(whole_surface(search, template), exclusion_px=exclusion_px))


def test_the_peak_of_a_window_without_texture_is_finite():
    found = on_device(prepare(torch.zeros(60, 70)), torch.rand(20, 30), 3.0)
    assert (found.x, found.y, found.score, found.second_score) == (0.0, 0.0, 0.0, 0.0)


def test_a_surface_does_not_leave_its_device(monkeypatch):
    copies, real = [], torch.Tensor.cpu
    monkeypatch.setattr(torch.Tensor, "cpu", lambda self: copies.append(self.numel()) or real(self))
    on_device(*picture((150, 131), (63, 50)), 5.0)
    assert copies == [28]


def test_a_template_larger_than_the_window_is_refused():
    with pytest.raises(ShapeError, match=r"^templates: expected at most 20 x 20 \(search\), got 21 x 5$"):
        match_templates([prepare(torch.rand(20, 20))], [torch.rand(21, 5)], exclusion_px=3.0)


def test_the_plain_twins_take_the_first_of_equals():
    products, norms = torch.zeros(2, 5, 6), torch.ones(5, 6)
    products[0, 2, 3] = products[0, 4, 1] = 0.5
    best, places = kernels.peak(products, norms)
    assert (best.tolist(), places.tolist()) == ([0.5, 0.0], [15, 0])
    assert kernels.rival(products, norms, places, 0).tolist() == [0.5, 0.0]
    assert kernels.rival(products, norms, places, 99).tolist() == [-1.0, -1.0]
