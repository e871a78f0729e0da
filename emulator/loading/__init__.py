"""Read and check a scenario file; all its mistakes are reported at once.

Source: docs/scenario.md.
"""

from evedrop.loading.file import checked, load, parse, read, set_entry, shipped, tables_in, value_of, write_new

__all__ = ["checked", "load", "parse", "read", "set_entry", "shipped", "tables_in", "value_of", "write_new"]
