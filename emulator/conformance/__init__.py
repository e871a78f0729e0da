"""What a class must do to be used in a run: checked on small problems, for `evedrop check` and before every run.

Source: docs/your-own.md.
"""
