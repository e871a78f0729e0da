"""Recordings: of links, messages, states and a plant's disturbances, and the models that explain them best.

Source: docs/links.md; docs/mathematics/links.md, estimating a link.
"""
