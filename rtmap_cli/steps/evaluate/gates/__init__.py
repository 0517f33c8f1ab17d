"""What CI asks of every figure: limits, a baseline, no leak."""
