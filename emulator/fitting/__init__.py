"""From a recording of a link to the model that a scenario can have for it.

Source: docs/mathematics.md, estimating a link; docs/links.md.
"""
