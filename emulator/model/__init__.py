"""Mathematics: no I/O, no clock, no network, no view. Batches have the trials as last axis."""
