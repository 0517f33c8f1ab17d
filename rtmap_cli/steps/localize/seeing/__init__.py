"""What a run sees and a map has, brought together: vertices, lines, residuals, their errors."""
