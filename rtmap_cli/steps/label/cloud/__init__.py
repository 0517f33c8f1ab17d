"""From the sweeps of a log to a trajectory and a point cloud."""
