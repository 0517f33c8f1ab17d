"""Where each frame stands on the prior map, and how sure (Eq. 4)."""
