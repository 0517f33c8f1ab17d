"""Alg. 1 of the campus paper: predictions → grids → lines → cells that differ → changes."""
