"""What came from the vehicle (Log, Frame, Camera, Rig) and what was made of it (Run)."""
