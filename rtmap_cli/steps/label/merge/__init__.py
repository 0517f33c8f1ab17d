"""Edits made by hand, carried over to newly generated labels."""
