"""From observations to events: what is gone, new or confirmed."""
