"""The default network: a bird's-eye picture first, then one refinement decoder."""
