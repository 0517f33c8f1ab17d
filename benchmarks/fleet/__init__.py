"""The fleet benchmark of RTMAP_GOLDEN with its bars."""
