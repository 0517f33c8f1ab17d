"""Lanes from drives: traces, lanes that they share, a graph of lanelets, their borders."""
