"""The metrics, against peers."""
