"""The mathematics: without I/O, clock, network or view. In batches the trials are the last axis."""
