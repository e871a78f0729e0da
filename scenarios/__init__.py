"""The shipped scenarios, found by name."""
