"""Heights for the vertices of a map, from the ground of a point cloud."""
