"""A heated room."""
