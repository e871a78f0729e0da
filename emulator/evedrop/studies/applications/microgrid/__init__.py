"""A day of a house with solar panels, made once and stored: sun, appliances, and the file of the day."""
