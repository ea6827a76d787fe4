"""Raster files as maps: grids, tiles, pyramids, surface models, and copies on a metric grid."""
