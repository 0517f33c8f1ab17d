"""The networks: model card, latency, training recipes."""
