"""`python -m emulator` is the command `evedrop`."""

from emulator.entry import program

program()
