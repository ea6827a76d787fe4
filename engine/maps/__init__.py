"""Raster files as maps: grids, tiles, pyramids, surface models, and what a method has prepared of a map, once."""
