"""The semi-automatic update, and the grid map that it starts from."""
