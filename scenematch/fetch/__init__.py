"""Maps fetched from servers that the user names, by GDAL: tiles, WMS and WMTS, and heights by files."""
