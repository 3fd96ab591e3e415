"""A running digital shadow or digital twin of a plant."""
