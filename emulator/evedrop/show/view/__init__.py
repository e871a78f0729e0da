"""Recordings and their layout, viewers, and pictures of studies. Only this package imports rerun and matplotlib."""
