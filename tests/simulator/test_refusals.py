"""What cannot be simulated is refused by the name of the argument."""

from functools import cache, partial

import numpy as np
import pytest

from engine import Attitude, Camera, OptionError
from scenematch.runs.simulation import WorldSettings
from scenematch.simulator import LIGHTS, Condition, FlightStyle, SensorNoise, build_town, plan_flight
from scenematch.simulator.flight import paper_camera
from scenematch.simulator.optics import through_lens
from scenematch.simulator.render import Atmosphere, render_frame
from tests.support.patches import CAMERA, ORIGIN, patch_world
from tests.support.towns import drawn_town

LEVEL = Attitude(0.0, 0.0, 0.0)
BENT = Camera(300, 300, CAMERA.matrix, distortion=np.array([0.1, 0, 0, 0, 0]))
WIDE = Camera(300, 300, np.array([[60, 0, 149.5], [0, 60, 149.5], [0, 0, 1]]), "equidistant", np.zeros(4))


def numbers_of(kind):
    """Names of the fields that hold a number."""
    return [name for name, field in kind.__dataclass_fields__.items() if isinstance(field.default, int | float)]


@cache
def world():
    return patch_world(600, 600, 30.0)


def seen(height_agl_m=150.0, attitude=LEVEL, camera=CAMERA):
    return render_frame(world(), camera, ORIGIN, height_agl_m, attitude)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: seen(height_agl_m=25.0), "height_agl_m: expected above the highest"),
        (lambda: seen(attitude=Attitude(0.0, 76.0, 0.0)), "attitude"),
        (lambda: seen(camera=BENT), "camera: expected a pinhole"),
        (lambda: seen(camera=paper_camera(-10.0)), "attitude: expected a camera that looks at the ground"),
        (lambda: through_lens(world(), WIDE, ORIGIN, 150.0, LEVEL), "camera: expected a lens"),
        (lambda: WorldSettings(camera_pitch_deg=-20.0), "camera_pitch_deg: expected -90 .* to -30, got -20"),
        (lambda: build_town(-1), "seed: expected 0 or more, got -1"),
        (lambda: build_town(width_px=8), "town: expected 16 px"),
        (lambda: build_town(condition="storm"), "condition: expected one of noon, evening, .*, got 'storm'"),
        (lambda: build_town(relief_m=-1.0), "relief_m: expected 0 to"),
        (lambda: Condition(light=LIGHTS["noon"], snow=1.5), r"snow: expected 0 to 1, got 1\.5"),
        (lambda: Atmosphere(visibility_m=0.0), "visibility_m: expected a number above 0"),
        (lambda: FlightStyle(acceleration_mps2=2.0), "peak_tilt_deg"),
        (lambda: FlightStyle(cruise_mps=0.0), "cruise_mps"),
        (lambda: plan_flight(town=drawn_town(), frames=0), "frames"),
        (lambda: plan_flight(town=drawn_town(), rate_hz=0.0), "rate_hz"),
        (lambda: plan_flight(town=drawn_town(), style=FlightStyle(height_agl_m=400.0)),
         "town: expected a map larger"),
        *((partial(kind, **{name: value}), name)
          for kind in (SensorNoise, FlightStyle) for name in numbers_of(kind) for value in (-1.0, np.nan)),
    ],
)  # fmt: skip
def test_an_option_that_cannot_be_is_refused(make, words):
    with pytest.raises(OptionError, match=words):
        make()
