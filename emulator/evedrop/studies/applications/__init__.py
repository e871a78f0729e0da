"""Applications of the emulator, each with its own data, metrics and panels."""
