"""Landmarks of a map that are found once, however many matchers ask for them."""

from functools import lru_cache

from engine.maps.landmarks import LandmarkMap

landmarks_of = lru_cache(maxsize=6)(LandmarkMap)
