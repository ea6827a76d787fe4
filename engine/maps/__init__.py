"""Raster files as maps: grids, tiles, pyramids, surface models, and data that methods prepare once from a map."""
