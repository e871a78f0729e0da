"""Numerical building blocks that give the same bits on every machine."""
