"""What the cameras of a drive see: rigs, styles, rendering."""
