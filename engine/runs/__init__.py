"""Whole runs: follow a flight, compare methods, campaigns, simulation, bridges; a library, without a command line."""
