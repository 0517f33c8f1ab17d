"""Change detection against changes that are known."""
