"""Average precision of maps, frame by frame and as a whole."""
