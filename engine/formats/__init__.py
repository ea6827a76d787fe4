"""Readers and writers of what lies on disk: telemetry, truth, frames, flights, tracks, GeoTIFF."""
