"""Two maps of one area become one: what both know is kept once, what only one knows is added."""
