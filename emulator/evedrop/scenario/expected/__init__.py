"""Theory's expectations of a scenario, and statements about a run before it starts."""
