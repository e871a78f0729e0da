"""The messages of a live run, one family per file, and the brief of a process."""
