"""Rules for classes that are used in a run, checked on small problems, by `evedrop check` and before every run.

Source: docs/your-own/rules.md.
"""
