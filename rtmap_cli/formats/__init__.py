"""Other people's files, one module per format, read and write."""
