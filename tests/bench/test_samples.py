"""Miniatures of the public repositories become flight folders."""

import sys

import cv2
import numpy as np
import pytest
import rasterio

from bench import datasets, samples
from engine import OrthoMap
from engine.values import Attitude
from scenematch.files.telemetry import read_telemetry
from scenematch.files.truth import read_truth
from scenematch.simulator import picture_at
from scenematch.simulator.flight import paper_camera
from tests.support.towns import drawn_town

HEADING_DEG, HEIGHT_M = 30.0, 150.0


def made(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["samples", *map(str, arguments)])
    samples.main()


def test_from_above_a_pixel_shows_its_highest_point_and_gaps_the_nearest():
    points = np.array([[500000.0, 10.0, 1.0, 7.0], [500000.02, 10.02, 3.0, 9.0], [500000.0, 13.0, 2.0, 5.0]])
    seen, near, corner = samples.from_above(points)
    assert seen.shape == (31, 1, 2)
    assert corner == pytest.approx([500000.0, 13.1])
    np.testing.assert_array_equal(seen[:, 0], np.where(np.arange(31)[:, None] <= 15, [2.0, 5.0], [3.0, 9.0]))
    np.testing.assert_array_equal(near[:, 0], np.abs(np.arange(31) - 15) >= 5)


@pytest.fixture(scope="module")
def clone(flight, tmp_path_factory):
    """A clone with a level flight over the town, and where each frame was taken."""
    root = tmp_path_factory.mktemp("clone")
    (root / "SIFT-based").mkdir()
    (root / "SIFT-based" / "1.tif").symlink_to(flight / "map.tif")
    town, camera, rng = drawn_town(), paper_camera(), np.random.default_rng(1)
    frame = OrthoMap.open(flight / "map.tif").frame
    ways_m = 2.0 * np.arange(31) * np.array([[np.sin(np.radians(HEADING_DEG))], [np.cos(np.radians(HEADING_DEG))]])
    writer = cv2.VideoWriter(
        str(root / "SIFT-based" / "our_data.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (300, 300)
    )
    for east, north in ways_m.T:
        where, attitude = np.array([east, north, HEIGHT_M]), Attitude(0.0, 0.0, HEADING_DEG)
        writer.write(cv2.cvtColor(picture_at(town, camera, frame, where, attitude, rng), cv2.COLOR_RGB2BGR))
    writer.release()
    return root, frame, ways_m.T


def test_the_campus_is_located_on_its_map(clone, tmp_path, monkeypatch):
    root, frame, ways_m = clone
    made(monkeypatch, "campus", root, "--out", tmp_path / "site")
    rows, truth = read_telemetry(tmp_path / "site" / "telemetry.csv"), read_truth(tmp_path / "site" / "truth.csv")
    assert [row.frame for row in rows] == [str(index) for index in range(0, 31, samples.EVERY)]
    assert [row.timestamp_ns for row in rows] == [500_000_000 * k for k in range(7)]
    assert {row.heading_deg for row in rows} == {HEADING_DEG}
    found = [frame.enu_from_geodetic(row.lat_deg, row.lon_deg)[:2] for row in truth]
    middle = slice(2, -2)  # at the ends the mean is of one side
    np.testing.assert_allclose(found[middle], ways_m[:: samples.EVERY][middle], atol=1.5)


def test_places_far_from_their_neighbours_are_replaced():
    index = np.arange(0.0, 200.0, 5.0)
    straight = np.column_stack([index, 3.0 * index, 2.0 * index, index, -index])
    found = np.delete(straight, [7, 8], axis=0)
    found[20, 1:3] += 300.0
    np.testing.assert_allclose(samples.smoothed(found)[2:-2], straight[2:-2])


def test_what_is_no_clone_is_refused_and_nothing_is_left(tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=r"root: expected a clone with model\.laz, got"):
        made(monkeypatch, "park", tmp_path, "--out", tmp_path / "out")
    (tmp_path / "model.laz").touch()
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(SystemExit, match="laspy: expected the package, got none"):
        made(monkeypatch, "park", tmp_path, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_between_pieces_of_a_map_there_is_none(tmp_path):
    picture = np.full((40, 40, 3), 100, np.uint8)
    pieces = []
    for k in (0, 2):
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture)
        pieces.append(datasets.Piece(tmp_path / f"{k}.png", 10.0 + 1e-3 * k, 50.001, 10.001 + 1e-3 * k, 50.0))
    datasets.write_map(tmp_path / "map.tif", pieces)
    with rasterio.open(tmp_path / "map.tif") as file:
        np.testing.assert_array_equal(file.dataset_mask()[0] > 0, np.repeat([True, False, True], 40))
