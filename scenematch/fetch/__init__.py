"""Maps fetched from servers that the user names: tiles by XYZ and WMTS, pictures by WMS, heights by files."""
