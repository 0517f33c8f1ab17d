"""Procedural towns: streets, junctions, lanes, paint."""
