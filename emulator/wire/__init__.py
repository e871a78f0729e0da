"""A wire: links with faults between programs that know nothing of Evedrop, over Zenoh. docs/wire.md."""
