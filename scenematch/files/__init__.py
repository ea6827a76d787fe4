"""Readers and writers of files: flights, frames, telemetry, truth, tracks, logs, bags, GeoTIFF."""
