"""Many runs and a prior become the next map version (Eq. 5)."""
