"""The map: elements, their CRS, immutable GeoParquet tiles and versions."""
