"""Applications of the emulator, each with its own data, figures and panels."""
