"""Audit of a map: where on it, and along a route, matching can be trusted."""
