"""Several systems and the water between their modems."""
