"""The metrics of the field, exactly: map AP, poses, changes."""
