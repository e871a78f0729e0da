"""The simulated world: all programs of a run or a wire in one interpreter, in virtual time; a seed decides everything else.

Source: docs/maintainers/simulated-world.md.
"""
