"""The command line: its commands, their output, and the handling of errors."""
