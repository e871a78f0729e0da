"""Finds the model of a recorded link for use in a scenario.

Source: docs/mathematics.md, estimating a link; docs/links.md.
"""
