"""Theory: expectations, limits, bounds, and the choice of parameters."""
