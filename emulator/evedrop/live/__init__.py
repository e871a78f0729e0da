"""One run over Zenoh: every process a program of its own."""
