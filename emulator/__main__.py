"""`python -m emulator` is the command `evedrop`."""

from emulator.cli import program

program()
