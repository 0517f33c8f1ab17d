"""Drives put onto each other before they are fused, where no map says where they are."""
