"""The scenario: its file, tables and events, the checks of them and across them, and what theory expects of it.

Source: docs/scenario.md.
"""
