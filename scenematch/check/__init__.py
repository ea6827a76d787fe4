"""Checks: whether a flight's inputs agree, and where on a map fixes are available."""

from scenematch.check.diagnose import diagnose
from scenematch.check.findings import Diagnosis, Finding

__all__ = ["Diagnosis", "Finding", "diagnose"]
