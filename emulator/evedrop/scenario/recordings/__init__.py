"""Recordings that a scenario names: of links, and of a plant's disturbances."""
