"""Read and check a scenario file; all its mistakes are reported at once.

Source: docs/scenario.md.
"""

from evedrop.loading.file import (
    built_in_text,
    checked,
    load,
    parse,
    read,
    set_entry,
    shipped,
    tables_in,
    value_of,
    write_new,
)

__all__ = [
    "built_in_text",
    "checked",
    "load",
    "parse",
    "read",
    "set_entry",
    "shipped",
    "tables_in",
    "value_of",
    "write_new",
]
