"""Fetch maps by GDAL from servers that the user names: tiles, WMS and WMTS, and files of heights."""
