"""Where drives go: routes, lanes, traffic, GNSS and odometry errors."""
