"""The programs of a run, one process each. They take one argument: their brief."""
