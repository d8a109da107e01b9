"""A run as one HTML file with a player."""
