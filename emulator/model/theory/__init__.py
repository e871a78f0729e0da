"""What theory says: expectations, limits, bounds, and the choice of parameters."""
