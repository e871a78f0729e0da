"""Numerical building blocks whose bits are the same on every machine."""
