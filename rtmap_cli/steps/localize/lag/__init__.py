"""A drive as it goes on: fixed-lag smoothing in a window that moves along."""
