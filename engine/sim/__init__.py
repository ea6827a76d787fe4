"""The software-in-the-loop flight: a simulated town, the camera over it, the vehicle and its sensors."""

from engine.sim.conditions import CONDITIONS, Condition
from engine.sim.flight import FlightPlan, SimulatedFlight, TownOptions, picture_at, plan_flight
from engine.sim.light import LIGHTS, Light
from engine.sim.optics import ExposureMotion, Optics, take_picture
from engine.sim.raster_world import world_from_map
from engine.sim.render import World, render_frame
from engine.sim.town import Town, build_town
from engine.sim.vehicle import FlightStyle, Motion, SensorNoise

__all__ = [
    "CONDITIONS",
    "LIGHTS",
    "Condition",
    "ExposureMotion",
    "FlightPlan",
    "FlightStyle",
    "Light",
    "Motion",
    "Optics",
    "SensorNoise",
    "SimulatedFlight",
    "Town",
    "TownOptions",
    "World",
    "build_town",
    "picture_at",
    "plan_flight",
    "render_frame",
    "take_picture",
    "world_from_map",
]
