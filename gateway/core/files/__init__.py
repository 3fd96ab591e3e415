"""The files that a user writes: safe reading, YAML, device profiles, recordings."""
