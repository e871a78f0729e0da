"""The trials of a live run without a network: simulation, Monte Carlo, and its workers."""
