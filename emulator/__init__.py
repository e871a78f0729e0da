"""Evedrop: a network emulator for secrecy in remote state estimation."""
