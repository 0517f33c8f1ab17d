"""From towns and logs to frames on disk, and from frames to samples and batches."""
