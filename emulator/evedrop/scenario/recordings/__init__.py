"""Recordings: of links, messages, states and a plant's disturbances, and the models that explain them best.

Source: docs/links.md; docs/mathematics.md, estimating a link.
"""
