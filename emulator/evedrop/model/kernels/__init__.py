"""Arithmetic that gives the same bits on every machine: the hot loops in C, and the same in numpy.

`current` has the functions in use, `reference` those in numpy, `compiled` those in C, `choice` decides between the two, and
`elementary` has functions of numbers. `factored` and `mixtures` are the parts of the Bayesian eavesdropper in numpy; other
eavesdroppers use them, too.
"""
