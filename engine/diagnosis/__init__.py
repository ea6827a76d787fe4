"""Diagnosis: whether telemetry, camera, clock and map of a flight fit each other, and what would make them."""

from engine.diagnosis.diagnose import diagnose
from engine.diagnosis.findings import Diagnosis, Finding

__all__ = ["Diagnosis", "Finding", "diagnose"]
