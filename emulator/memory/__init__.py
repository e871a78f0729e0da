"""The same trials without a network: simulation, Monte Carlo, and its workers."""
