"""A whole drive at once: motion, the field of place errors, the block solver."""
