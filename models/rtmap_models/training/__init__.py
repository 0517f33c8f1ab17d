"""The loop, what it starts from and leaves behind, and how good the result is."""
