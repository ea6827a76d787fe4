"""Whole runs as a library: follow a flight, compare methods, campaigns, simulation, bridges."""
