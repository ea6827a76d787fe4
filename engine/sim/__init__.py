"""The software-in-the-loop flight: a simulated town, the camera over it, the vehicle and its sensors."""

from engine.sim.flight import Plan, SimulatedFlight, paper_flight, plan_flight
from engine.sim.render import LIGHTS, Light, World, render_frame
from engine.sim.town import Town, build_town
from engine.sim.vehicle import FlightStyle, Motion, SensorNoise

__all__ = [
    "LIGHTS",
    "FlightStyle",
    "Light",
    "Motion",
    "Plan",
    "SensorNoise",
    "SimulatedFlight",
    "Town",
    "World",
    "build_town",
    "paper_flight",
    "plan_flight",
    "render_frame",
]
