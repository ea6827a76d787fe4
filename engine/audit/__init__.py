"""Audit of a map: where on it, and along a route, fixes are available."""
