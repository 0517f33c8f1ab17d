"""Measurements beside bars and peers: `python -m benchmarks.ROOM.NAME --help`."""
