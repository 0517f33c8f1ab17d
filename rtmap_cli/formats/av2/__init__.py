"""Argoverse 2 and Trust-but-Verify logs and maps as they lie on disk."""
