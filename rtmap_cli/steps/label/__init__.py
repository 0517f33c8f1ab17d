"""A first map from a drive: point cloud, lanes, labels."""
