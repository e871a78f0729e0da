"""The programs of a run's peers, one process each. They take one argument: their brief."""
