"""Diagnosis: whether telemetry, camera, clock and map of a flight fit each other, and what would make them."""

from engine.diagnosis.causes import Diagnosis, Finding
from engine.diagnosis.diagnose import diagnose

__all__ = ["Diagnosis", "Finding", "diagnose"]
