"""Where along a drive a frame stands: bends, loops, junctions, lanes."""
