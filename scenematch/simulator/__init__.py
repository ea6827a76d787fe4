"""The software-in-the-loop flight: a simulated town, the camera over it, the vehicle and its sensors."""

from scenematch.simulator.conditions import CONDITIONS, Condition
from scenematch.simulator.flight import FlightPlan, picture_at, plan_flight
from scenematch.simulator.light import LIGHTS, Light
from scenematch.simulator.raster_world import world_from_map
from scenematch.simulator.render import World, render_frame
from scenematch.simulator.town import Town, build_town
from scenematch.simulator.vehicle import FlightStyle, Motion, SensorNoise

__all__ = [
    "CONDITIONS",
    "LIGHTS",
    "Condition",
    "FlightPlan",
    "FlightStyle",
    "Light",
    "Motion",
    "SensorNoise",
    "Town",
    "World",
    "build_town",
    "picture_at",
    "plan_flight",
    "render_frame",
    "world_from_map",
]
