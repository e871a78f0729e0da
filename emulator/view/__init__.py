"""Recordings, their layout, and figures. Only this package uses rerun and matplotlib."""
