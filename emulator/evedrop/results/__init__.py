"""Results on disk: written, read and compared."""
