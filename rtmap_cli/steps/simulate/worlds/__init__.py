"""What stands in the world of a map, and how it changes or was mapped less exactly."""
