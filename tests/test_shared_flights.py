"""Recorded flights over two towns and a campus: as accurate as the paper's recipe with tilt, and never wrong."""

from functools import cache

import numpy as np
import pytest

from bench.accuracy.flights import moved_to_middle
from engine import Camera, Fix, OrthoMap, Prior, SceneMatcher
from scenematch.files.flight import open_flight
from scenematch.files.truth import interpolate_truth, read_truth

WRONG_M = 10.0


@cache
def recorded(folder, frames):
    """Map, camera, flight and truth of a recorded flight."""
    if not folder.is_dir():
        pytest.skip(f"the flight {folder.name} is not there: {folder}")
    surface, camera = folder / "dsm.tif", Camera.load(folder / "camera.yaml")
    site = OrthoMap.open(folder / "map.tif", surface=surface if surface.exists() else None)
    flight = open_flight(folder / frames, folder / "telemetry.csv", camera)
    return site, camera, flight, read_truth(folder / "truth.csv")


@pytest.fixture
def errors_of(shared, error_m):
    def measure(name, method, picked, *, sigma_m=5.0, frames="frames", middle=False):
        """Metres from the truth of a slice of the frames, infinite where one was refused.

        Without a sigma nothing is known before. The truth may be the ground in the middle of each frame instead
        of the camera's own place.
        """
        site, camera, flight, known = recorded(shared / name, frames)
        matcher, errors = SceneMatcher(site, camera, method, "cpu"), []
        for index in range(len(flight))[picked]:
            frame = flight.read(index).frame
            truth = interpolate_truth(known, frame.timestamp_ns)
            prior = sigma_m and Prior(lat_deg=truth.lat_deg, lon_deg=truth.lon_deg, sigma_m=sigma_m)
            result = matcher.locate(frame, prior or None)
            if isinstance(result, Fix) and middle:
                result = moved_to_middle(result, site, camera)
            errors.append(error_m(site, result, truth) if isinstance(result, Fix) else np.inf)
        return np.array(errors)

    return measure


RMS_M = {("gazebo-a1", "ncc"): 1.46, ("gazebo-a1", "sift"): 1.23}
RMS_M |= {("gazebo-a2", "ncc"): 1.53, ("gazebo-a2", "sift"): 1.26}


@pytest.mark.parametrize(("town", "method"), RMS_M)
def test_a_town_is_matched_as_accurately_as_the_papers_recipe_with_tilt(errors_of, town, method):
    errors = errors_of(town, method, slice(None, None, 40))
    known = errors[np.isfinite(errors)]
    assert len(known) >= 0.9 * len(errors)
    assert known.max() <= WRONG_M
    assert np.sqrt(np.mean(known**2)) <= RMS_M[town, method]


@pytest.mark.parametrize(("town", "method"), RMS_M)
def test_a_place_in_a_town_is_found_from_nothing(errors_of, town, method):
    assert errors_of(town, method, slice(100, 501, 200), sigma_m=None).max() <= WRONG_M


@pytest.mark.slow
def test_a_campus_is_matched_against_a_satellite_picture_of_another_day(errors_of):
    """Its truth is of the ground in mid-frame and good to a metre, its telemetry rounded to 5 m and 2 degrees."""
    errors = errors_of("nust", "ncc", slice(None, None, 10), frames="flight.mp4", middle=True)
    known = errors[np.isfinite(errors)]
    assert len(known) >= 0.8 * len(errors)
    assert known.max() < 5.0
