"""What other sensors than the cameras say of a simulated world: LiDAR sweeps, label masks."""
