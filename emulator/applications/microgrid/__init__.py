"""A day of a house with solar panels, made once and kept: sun, appliances, and the file they are kept in."""
