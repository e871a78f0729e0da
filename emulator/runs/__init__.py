"""A run: its processes, its score, its results, and the same trials in memory."""
