"""Truths about learned matchers: their pixels, and what a weights file must be. No weights are downloaded."""

import pickle
import re
import socket
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from kornia.feature import DISK, LightGlue, LoFTR
from torch import nn

from engine.errors import DtypeError, OptionError, ShapeError
from engine.learned import load_matcher
from engine.learned.keypoints import by_disk
from engine.learned.matchers import KeypointMatcher, Loftr
from tests.support.refusals import misuse, refusal


@pytest.fixture(autouse=True)
def _no_network(monkeypatch):
    def refused(*_args, **_kwargs):
        raise AssertionError("the network was asked for")

    monkeypatch.setattr(socket.socket, "connect", refused)
    monkeypatch.setattr(socket, "getaddrinfo", refused)
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refused)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Random weights, as a user would have trained ones, and files that are none."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    disk, lightglue = DISK().state_dict(), lightglue_of(128)
    name = next(iter(disk))
    for path, content in {
        "loftr.ckpt": {"state_dict": LoFTR(pretrained=None).state_dict()},
        "disk.pth": {"extractor": disk},
        "lightglue.pth": lightglue,
        "other.pth": {"layer.weight": torch.zeros(2)},
        "wide.pth": lightglue_of(256),
        "scaled.pth": lightglue_of(128, add_scale_ori=True),
        "mixed.pth": {n: lightglue[n] for n in lightglue if not n.startswith("transformers.1.")}
        | {"unet.x": torch.zeros(1)},
        "bent.pth": disk | {name: disk[name][:1, :1]},
        "list.pth": [1, 2],
        "nothing.pth": {},
        "numbers.pth": {"state_dict": {"a": 1}},
        "tensor.pth": torch.zeros(3),
    }.items():
        torch.save(content, folder / path)
    (folder / "empty.pth").write_bytes(b"")
    (folder / "text.pth").write_bytes(b"hello")
    (folder / "cut.pth").write_bytes((folder / "disk.pth").read_bytes()[:10_000])
    return folder


def lightglue_of(numbers, **options):
    """Random weights of LightGlue for descriptors of so many numbers."""
    return LightGlue(features=None, input_dim=numbers, n_layers=2, **options).state_dict()


def picture(height, width, seed=0):
    coarse = torch.rand(1, 1, height // 4 + 2, width // 4 + 2, generator=torch.Generator().manual_seed(seed))
    return nn.functional.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0, 1)


# Pixels.


class Brightest(nn.Module):
    """Stands for LoFTR: says where the brightest pixel of each picture is, and keeps the sizes it was given."""

    def __init__(self):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(1))

    def forward(self, data):
        self.sizes = [tuple(data[name].shape[2:]) for name in ("image0", "image1")]
        found = {}
        for i in range(2):
            image = data[f"image{i}"][0, 0]
            y, x = divmod(int(image.argmax()), image.shape[1])
            found[f"keypoints{i}"] = torch.tensor([[x, y], [x, y], [image.shape[1] - 1, 0]], dtype=torch.float32)
        return {**found, "confidence": torch.tensor([0.9, 0.1, 0.9])}


def test_points_are_pixels_of_the_pictures_that_came_in():
    frame, crop = torch.zeros(1, 1, 45, 61), torch.zeros(1, 1, 50, 70)
    frame[0, 0, 44, 60], crop[0, 0, 7, 11] = 1, 1
    network = Brightest()
    found = Loftr(network, min_confidence=0.5)(frame, crop)
    assert network.sizes == [(48, 64), (56, 72)]  # whole cells
    # The doubtful match and the one in the padding are left out; the others are neither moved nor scaled.
    assert [points.tolist() for points in found] == [[[60, 44]], [[11, 7]]]


@pytest.mark.slow
def test_a_cell_of_loftr_lies_on_its_eighth_pixel():
    """What a cell sees is centred on pixel (8x, 8y): not half a cell further, and not half a pixel."""
    torch.manual_seed(1)
    network = LoFTR(pretrained=None).eval()
    image = picture(160, 176).requires_grad_()
    coarse, _ = network.backbone(image)
    row, column = 10, 11
    (seen,) = torch.autograd.grad(coarse[0, :, row, column].sum(), image)
    for axis, cell in ((0, row), (1, column)):
        touched = seen[0, 0].abs().sum(dim=1 - axis).nonzero().flatten()
        assert touched[0] > 0
        assert touched[-1] < image.shape[2 + axis] - 1
        assert (touched[0] + touched[-1]) / 2 == 8 * cell


def corners(*points):
    """Stands for DISK: keypoints at given pixels of one picture after the other."""
    left = list(points)

    def network(images, n, pad_if_not_divisible):
        assert pad_if_not_divisible
        assert images.shape[1] == 3
        at = left.pop(0)
        strength, descriptors = torch.arange(len(at), 0, -1), torch.ones(len(at), 128)
        keypoints = torch.tensor(at).reshape(-1, 2)
        return [SimpleNamespace(keypoints=keypoints, descriptors=descriptors, detection_scores=strength)]

    return network


class Reversed(nn.Module):
    """Stands for LightGlue: the first with the last; the last has no partner."""

    def __init__(self):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(1))

    def forward(self, data):
        self.sizes = [data[name]["image_size"].tolist() for name in ("image0", "image1")]
        partner = torch.arange(data["image0"]["keypoints"].shape[1] - 1, -1, -1)
        partner[-1] = -1
        return {"matches0": partner[None]}


def test_sparse_points_come_back_in_pairs_and_unmoved():
    points = [[0.0, 0.0], [5.0, 6.0], [9.0, 3.0]], [[1.0, 1.0], [20.0, 30.0], [40.0, 7.0]]
    lightglue = Reversed()
    matcher = KeypointMatcher(partial(by_disk, corners(*points)), lightglue, 2048)
    found = matcher(torch.zeros(1, 1, 45, 61), torch.zeros(1, 1, 50, 70))
    assert [points.tolist() for points in found] == [[[0, 0], [5, 6]], [[40, 7], [20, 30]]]
    assert lightglue.sizes == [[[61, 45]], [[70, 50]]]  # width first


def test_nothing_found_is_no_match():
    matcher = KeypointMatcher(partial(by_disk, corners([[0.0, 0.0]], [])), Reversed(), 2048)
    first, second = matcher(torch.zeros(1, 1, 45, 61), torch.zeros(1, 1, 50, 70))
    assert first.shape == second.shape == (0, 2)


# Loaded from a file.


@pytest.mark.slow
def test_loftr_is_what_the_file_says(files):
    matcher = load_matcher([files / "loftr.ckpt"], device="cpu", min_confidence=0.0)
    stored = torch.load(files / "loftr.ckpt", weights_only=True)["state_dict"]
    assert not matcher.network.training
    assert all(torch.equal(value, stored[name]) for name, value in matcher.network.state_dict().items())
    first, second = matcher(picture(77, 93), picture(84, 101))
    assert first.shape == second.shape == (len(first), 2)
    assert not first.requires_grad


def test_disk_and_lightglue_are_what_the_files_say(files, tmp_path):
    matcher = load_matcher([files / "disk.pth", files / "lightglue.pth"], device="cpu", max_keypoints=50)
    image = picture(77, 93)
    first, second = matcher(image, image)
    assert first.shape == second.shape
    assert (first == first.round()).all()
    # The names under which LightGlue was published.
    now = torch.load(files / "lightglue.pth", weights_only=True)
    published = {
        ".".join([p[2], p[1], *p[3:]]) if p[0] == "transformers" else name: value
        for name, value in now.items()
        for p in [name.split(".")]
        if name != "confidence_thresholds"
    }
    assert "self_attn.0.Wqkv.weight" in published
    published |= {f"log_assignment.{i}.r": torch.ones(1) for i in range(2)}  # left over from training
    torch.save(published, tmp_path / "published.pth")
    again = load_matcher([tmp_path / "published.pth", files / "disk.pth"], device="cpu")  # in any order
    assert isinstance(again.extractor.args[0], DISK)
    assert all(torch.equal(value, now[name]) for name, value in again.lightglue.state_dict().items())


@pytest.mark.parametrize("name", ["aliked-t16", "aliked-n16", "aliked-n32"])
def test_aliked_is_of_the_size_of_its_file(name, tmp_path):
    from kornia.feature import ALIKED

    torch.manual_seed(2)
    torch.save(ALIKED(name).state_dict(), tmp_path / "aliked.pth")
    dim = 64 if name == "aliked-t16" else 128
    torch.save(lightglue_of(dim), tmp_path / "lightglue.pth")
    matcher = load_matcher([tmp_path / "aliked.pth", tmp_path / "lightglue.pth"], device="cpu")
    assert matcher.extractor.args[0].model_name == name
    found = matcher.extract(picture(64, 96), 30)
    assert 2 <= len(found) <= 30
    assert found.descriptors.shape == (len(found), dim)
    every = matcher.extractor.args[0](picture(64, 96).expand(-1, 3, -1, -1))[0]
    strongest = every.keypoint_scores.argsort(descending=True, stable=True)[:30]
    assert torch.equal(found.xy_px, every.keypoints[strongest])


REFUSED = {
    "": r"weights: expected the files of LoFTR, or LightGlue .* got none",
    "disk.pth": r"weights: expected .*, got DISK$",
    "disk.pth disk.pth": r"weights: expected .*, got DISK and DISK$",
    "loftr.ckpt lightglue.pth": r"weights: expected .*, got LightGlue and LoFTR$",
    "disk.pth other.pth": r"other.pth: expected DISK, ALIKED, .* got tensors named layer.weight",
    "disk.pth wide.pth": r"wide.pth: expected LightGlue for descriptors of 128 numbers, .* 256",
    "disk.pth scaled.pth": r"scaled.pth: expected LightGlue for DISK.* scales or shapes",
    "disk.pth mixed.pth": r"does not fit LightGlue: lacks transformers.* more; has unknown unet\.x",
    "bent.pth lightglue.pth": r"does not fit DISK: has other shapes of unet.path_down.0.1.3.weight$",
    "missing.pth": r"weights: no such file: .*missing.pth",
    ".": "no such file",  # a folder
    "empty.pth": r"weights: \S*empty.pth",
    "text.pth": r"weights: \S*text.pth",
    "cut.pth": r"weights: \S*cut.pth",
    **{f"{name}.pth": rf"{name}.pth: expected a state dict" for name in ("list", "nothing", "numbers", "tensor")},
}


@pytest.mark.parametrize("names", REFUSED)
def test_files_that_make_no_matcher_are_refused_in_one_line(files, names):
    paths = [files / name for name in names.split()]
    assert re.search(REFUSED[names], misuse(load_matcher, paths, device="cpu"))


class Malicious:
    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return (Path.touch, (self.mark,))


@pytest.mark.parametrize("by", ["torch", "pickle"])
def test_a_pickle_that_runs_code_is_refused(by, tmp_path):
    mark, path = tmp_path / "was_here", tmp_path / "evil.pth"
    if by == "torch":
        torch.save({"state_dict": Malicious(mark)}, path)
    else:
        path.write_bytes(pickle.dumps(Malicious(mark), protocol=2))
    assert "evil.pth: expected tensors alone" in misuse(load_matcher, [path], device="cpu")
    assert not mark.exists()


# Wrong use.


def test_wrong_arguments_are_named(files):
    matcher = Loftr(Brightest(), 0.5)
    good = torch.zeros(1, 1, 20, 20)
    assert "frame: expected (1, 1, H, W), got (20, 20)" in refusal(matcher, good[0, 0], good, error=ShapeError)
    assert "crop" in refusal(matcher, good, good.expand(2, -1, -1, -1), error=ShapeError)
    assert "crop: expected floating point" in refusal(matcher, good, good.to(torch.uint8), error=DtypeError)
    for name, value in (("min_confidence", 1.5), ("max_keypoints", 1)):
        with pytest.raises(OptionError, match=name):
            load_matcher([files / "loftr.ckpt"], **{name: value})
