"""The parts of a slot: process, packets, links and beliefs."""
