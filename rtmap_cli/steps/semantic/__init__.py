"""`rtmap semantic-map`: what the ground is made of, seen by cameras and measured by LiDAR."""
