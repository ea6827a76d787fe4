"""Recorded flights over two towns and a campus: as accurate as the paper's recipe with tilt, and never wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from bench.accuracy.flights import moved_to_middle
from engine import Camera, Fix, OrthoMap, Prior, SceneMatcher
from engine.values import Truth
from scenematch.files.flight import Flight, open_flight
from scenematch.files.truth import interpolate_truth, read_truth

WRONG_M = 10.0


@dataclass
class Recorded:
    site: OrthoMap
    camera: Camera
    flight: Flight
    truth: list[Truth]

    def errors(self, method, error_m, indices, *, sigma_m=5.0, middle=False):
        """Metres from the truth, infinite where a frame was refused; without a sigma nothing is known before.

        The truth may be the ground in the middle of each frame instead of the camera's own place.
        """
        matcher = SceneMatcher(self.site, self.camera, method, "cpu")
        errors = []
        for index in indices:
            frame = self.flight.read(index).frame
            truth = interpolate_truth(self.truth, frame.timestamp_ns)
            prior = sigma_m and Prior(lat_deg=truth.lat_deg, lon_deg=truth.lon_deg, sigma_m=sigma_m)
            result = matcher.locate(frame, prior or None)
            if isinstance(result, Fix) and middle:
                result = moved_to_middle(result, self.site, self.camera)
            errors.append(error_m(self.site, result, truth) if isinstance(result, Fix) else math.inf)
        return np.array(errors)


def recorded(folder, frames="frames"):
    if not folder.is_dir():
        pytest.skip(f"the flight {folder.name} is not there: {folder}")
    surface = folder / "dsm.tif"
    camera = Camera.load(folder / "camera.yaml")
    return Recorded(
        OrthoMap.open(folder / "map.tif", surface=surface if surface.exists() else None),
        camera,
        open_flight(folder / frames, folder / "telemetry.csv", camera),
        read_truth(folder / "truth.csv"),
    )


@pytest.fixture(scope="module", params=["gazebo-a1", "gazebo-a2"])
def town(request, shared):
    return request.param, recorded(shared / request.param)


@pytest.fixture(scope="module")
def campus(shared):
    return recorded(shared / "nust", "flight.mp4")


RMS_M = {
    ("gazebo-a1", "ncc"): 1.46,
    ("gazebo-a2", "ncc"): 1.53,
    ("gazebo-a1", "sift"): 1.23,
    ("gazebo-a2", "sift"): 1.26,
}


@pytest.mark.parametrize("method", ["ncc", "sift"])
def test_a_town_is_matched_as_accurately_as_the_papers_recipe_with_tilt(town, error_m, method):
    name, flight = town
    errors = flight.errors(method, error_m, range(0, len(flight.flight), 40))
    known = errors[np.isfinite(errors)]
    assert len(known) >= 0.9 * len(errors)
    assert known.max() <= WRONG_M
    assert math.sqrt(np.mean(known**2)) <= RMS_M[name, method]


@pytest.mark.parametrize("method", ["ncc", "sift"])
def test_a_place_in_a_town_is_found_from_nothing(town, error_m, method):
    _, flight = town
    assert flight.errors(method, error_m, (100, 300, 500), sigma_m=None).max() <= WRONG_M


@pytest.mark.slow
def test_a_campus_is_matched_against_a_satellite_picture_of_another_day(campus, error_m):
    """Its truth is of the ground in mid-frame and good to a metre, its telemetry rounded to 5 m and 2 degrees."""
    errors = campus.errors("ncc", error_m, range(0, len(campus.flight), 10), middle=True)
    known = errors[np.isfinite(errors)]
    assert len(known) >= 0.8 * len(errors)
    assert known.max() < 5.0
