"""What theory expects of a scenario, and what can be said before it starts."""
