"""Truths about learned matchers: their pixels, and what a weights file must be. No weights are downloaded."""

import pickle
import socket
from pathlib import Path

import pytest
import torch
from kornia.feature import DISK, LightGlue, LoFTR
from torch import nn

from engine.errors import DtypeError, OptionError, ShapeError
from engine.learned import KeypointMatcher, Loftr, load_matcher
from engine.learned.keypoints import Disk, SuperPointKeypoints
from engine.learned.superpoint import SuperPoint, sample, strongest


@pytest.fixture(autouse=True)
def _no_network(monkeypatch):
    def refused(*_args, **_kwargs):
        raise AssertionError("the network was asked for")

    monkeypatch.setattr(socket.socket, "connect", refused)
    monkeypatch.setattr(socket, "getaddrinfo", refused)
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refused)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Random weights, as a user would have trained ones."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    torch.save({"state_dict": LoFTR(pretrained=None).state_dict()}, folder / "loftr.ckpt")
    torch.save({"extractor": DISK().state_dict()}, folder / "disk.pth")
    torch.save(LightGlue(features=None, input_dim=128, n_layers=2).state_dict(), folder / "lightglue.pth")
    return folder


def picture(height, width, seed=0):
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 1, height // 4 + 2, width // 4 + 2, generator=generator)
    return nn.functional.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0, 1)


# Pixels.


class Brightest(nn.Module):
    """Stands for LoFTR: says where the brightest pixel of each picture is, and keeps the sizes it was given."""

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
    first, second = Loftr(network, min_confidence=0.5)(frame, crop)
    assert network.sizes == [(48, 64), (56, 72)]  # whole cells
    # The doubtful match and the one in the padding are left out; the others are neither moved nor scaled.
    assert first.tolist() == [[60, 44]]
    assert second.tolist() == [[11, 7]]


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


class Corners(nn.Module):
    """Stands for DISK: keypoints at given pixels."""

    def __init__(self, points):
        super().__init__()
        self.points = points

    def forward(self, images, n, pad_if_not_divisible):
        assert pad_if_not_divisible
        assert images.shape[1] == 3
        points = self.points.pop(0)
        features = type("Features", (), {})()
        features.keypoints, features.descriptors = (
            torch.tensor(points).reshape(-1, 2),
            torch.ones(len(points), 128),
        )
        features.detection_scores = torch.arange(len(points), 0, -1)
        return [features]


class Reversed(nn.Module):
    """Stands for LightGlue: the first with the last; the last has no partner."""

    def __init__(self):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(1))

    def forward(self, data):
        self.sizes = [data[name]["image_size"].tolist() for name in ("image0", "image1")]
        count = data["image0"]["keypoints"].shape[1]
        partner = torch.arange(count - 1, -1, -1)
        partner[-1] = -1
        return {"matches0": partner[None]}


def test_sparse_points_come_back_in_pairs_and_unmoved():
    points = [[[0.0, 0.0], [5.0, 6.0], [9.0, 3.0]], [[1.0, 1.0], [20.0, 30.0], [40.0, 7.0]]]
    lightglue = Reversed()
    matcher = KeypointMatcher(Disk(Corners(points)), lightglue, 2048)
    first, second = matcher(torch.zeros(1, 1, 45, 61), torch.zeros(1, 1, 50, 70))
    assert first.tolist() == [[0, 0], [5, 6]]
    assert second.tolist() == [[40, 7], [20, 30]]
    assert lightglue.sizes == [[[61, 45]], [[70, 50]]]  # width first


def test_nothing_found_is_no_match():
    matcher = KeypointMatcher(Disk(Corners([[[0.0, 0.0]], []])), Reversed(), 2048)
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
    assert first.shape == second.shape
    assert first.shape[1] == 2
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
    again = load_matcher([files / "disk.pth", tmp_path / "published.pth"], device="cpu")
    assert all(torch.equal(value, now[name]) for name, value in again.lightglue.state_dict().items())


def test_files_are_recognised_in_any_order(files):
    for first, second in (("disk.pth", "lightglue.pth"), ("lightglue.pth", "disk.pth")):
        matcher = load_matcher([files / first, files / second], device="cpu", max_keypoints=20)
        assert isinstance(matcher.extractor, Disk)
    assert isinstance(load_matcher([files / "loftr.ckpt"], device="cpu"), Loftr)


@pytest.mark.parametrize("name", ["aliked-t16", "aliked-n16", "aliked-n32"])
def test_aliked_is_of_the_size_of_its_file(name, tmp_path):
    from kornia.feature import ALIKED

    torch.manual_seed(2)
    aliked = ALIKED(name)
    torch.save(aliked.state_dict(), tmp_path / "aliked.pth")
    dim = 64 if name == "aliked-t16" else 128
    torch.save(LightGlue(features=None, input_dim=dim, n_layers=2).state_dict(), tmp_path / "lightglue.pth")
    matcher = load_matcher([tmp_path / "aliked.pth", tmp_path / "lightglue.pth"], device="cpu")
    assert matcher.extractor.network.model_name == name
    found = matcher.extract(picture(64, 96), 30)
    assert 2 <= len(found) <= 30
    assert found.descriptors.shape == (len(found), dim)
    assert (found.strength.diff() <= 0).all()


def test_what_makes_no_matcher_is_told(files, tmp_path):
    disk, lightglue, loftr = (files / name for name in ("disk.pth", "lightglue.pth", "loftr.ckpt"))
    with pytest.raises(OptionError, match=r"weights: expected the files of LoFTR, or LightGlue .* got none"):
        load_matcher([])
    for paths, got in (
        ([disk], "DISK"),
        ([disk, disk], "DISK and DISK"),
        ([loftr, lightglue], "LightGlue and LoFTR"),
    ):
        with pytest.raises(OptionError, match=rf"weights: expected .*, got {got}$"):
            load_matcher(paths, device="cpu")
    torch.save({"layer.weight": torch.zeros(2)}, tmp_path / "other.pth")
    with pytest.raises(OptionError, match=r"other.pth: expected DISK, ALIKED, .* got tensors named layer.weight"):
        load_matcher([disk, tmp_path / "other.pth"], device="cpu")
    torch.save(LightGlue(features=None, input_dim=256, n_layers=1).state_dict(), tmp_path / "wide.pth")
    with pytest.raises(OptionError, match=r"wide.pth: expected LightGlue for descriptors of 128 numbers, .* 256"):
        load_matcher([disk, tmp_path / "wide.pth"], device="cpu")
    scaled = LightGlue(features=None, input_dim=128, n_layers=1, add_scale_ori=True)
    torch.save(scaled.state_dict(), tmp_path / "scaled.pth")
    with pytest.raises(OptionError, match=r"scaled.pth: expected LightGlue for DISK.* scales or shapes"):
        load_matcher([disk, tmp_path / "scaled.pth"], device="cpu")


# SuperPoint.


def test_superpoint_finds_the_same_places_in_a_picture_moved_by_a_cell():
    torch.manual_seed(3)
    extract = SuperPointKeypoints(SuperPoint().eval())
    whole = picture(120, 136)
    with torch.inference_mode():
        found, moved = extract(whole, 400), extract(whole[..., 8:, 16:], 400)
    places = {tuple(map(int, xy)): d for xy, d in zip(found.xy_px, found.descriptors, strict=True)}
    again = {(int(x) + 16, int(y) + 8): d for (x, y), d in zip(moved.xy_px, moved.descriptors, strict=True)}
    inner = [at for at in again if all(44 + 8 <= v < n - 44 for v, n in zip(at, (136, 120), strict=True))]
    assert inner  # beyond the reach of the edges
    assert all(at in places for at in inner)
    assert all(torch.allclose(places[at], again[at], atol=1e-4) for at in inner)


def test_superpoint_keeps_the_strongest_of_neighbours_and_reads_descriptors_at_cell_middles():
    scores = torch.zeros(40, 40)
    scores[20, 10], scores[22, 12], scores[30, 30], scores[1, 1] = 0.9, 0.8, 0.5, 0.99
    xy, strength = strongest(scores, 10)
    assert xy.tolist() == [[10, 20], [30, 30]]  # the neighbour is weaker, the corner too near to the edge
    assert strength.tolist() == pytest.approx([0.9, 0.5])
    cells = nn.functional.normalize(torch.randn(256, 5, 5, generator=torch.Generator().manual_seed(0)), dim=0)
    at = torch.tensor([[3.5 + 8 * 2, 3.5 + 8 * 4], [3.5, 3.5]])
    assert torch.allclose(sample(cells, at), torch.stack([cells[:, 4, 2], cells[:, 0, 0]]), atol=1e-6)


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
    with pytest.raises(OptionError, match=r"evil.pth: expected tensors alone"):
        load_matcher([path], device="cpu")
    assert not mark.exists()
    torch.load(path, weights_only=False) if by == "torch" else pickle.loads(path.read_bytes())
    assert mark.exists()  # it would have run


def test_files_that_are_no_weights_are_named(files, tmp_path):
    with pytest.raises(OptionError, match=r"weights: no such file: .*missing.pth"):
        load_matcher([tmp_path / "missing.pth"])
    with pytest.raises(OptionError, match="no such file"):
        load_matcher([tmp_path])  # a folder
    whole = (files / "disk.pth").read_bytes()
    for name, content in {"empty.pth": b"", "text.pth": b"hello", "cut.pth": whole[: len(whole) // 2]}.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(OptionError, match=rf"weights: \S*{name}") as caught:
            load_matcher([tmp_path / name])
        assert "\n" not in str(caught.value)
    for content in ([1, 2], {}, {"state_dict": {"a": 1}}, torch.zeros(3)):
        torch.save(content, tmp_path / "other.pth")
        with pytest.raises(OptionError, match=r"other.pth: expected a state dict"):
            load_matcher([tmp_path / "other.pth"])


def test_weights_of_another_network_are_named(files, tmp_path):
    mixed = torch.load(files / "lightglue.pth", weights_only=True)
    lost = [name for name in mixed if name.startswith("transformers.1.")]
    torch.save(
        {name: mixed[name] for name in mixed if name not in lost} | {"unet.x": torch.zeros(1)},
        tmp_path / "mixed.pth",
    )
    with pytest.raises(
        OptionError, match=r"does not fit LightGlue: lacks transformers.* more; has unknown unet\.x"
    ):
        load_matcher([files / "disk.pth", tmp_path / "mixed.pth"], device="cpu")
    state = torch.load(files / "disk.pth", weights_only=True)["extractor"]
    name = next(iter(state))
    state[name] = state[name][:1, :1]
    torch.save(state, tmp_path / "bent.pth")
    with pytest.raises(OptionError, match=rf"does not fit DISK: has other shapes of {name}$"):
        load_matcher([tmp_path / "bent.pth", files / "lightglue.pth"], device="cpu")


# Wrong use.


def test_wrong_arguments_are_named(files):
    matcher = Loftr(Brightest(), 0.5)
    good = torch.zeros(1, 1, 20, 20)
    with pytest.raises(ShapeError, match=r"frame: expected \(1, 1, H, W\), got \(20, 20\)"):
        matcher(good[0, 0], good)
    with pytest.raises(ShapeError, match="crop"):
        matcher(good, good.expand(2, -1, -1, -1))
    with pytest.raises(DtypeError, match="crop: expected floating point"):
        matcher(good, good.to(torch.uint8))
    with pytest.raises(OptionError, match="min_confidence"):
        load_matcher([files / "loftr.ckpt"], min_confidence=1.5)
    with pytest.raises(OptionError, match="max_keypoints"):
        load_matcher([files / "disk.pth", files / "lightglue.pth"], max_keypoints=1)
