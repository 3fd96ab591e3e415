"""Models of the environment that generate the shipped synthetic recordings."""
