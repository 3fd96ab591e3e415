"""Compare two runs of a system, and turn a recorded run into a scenario."""
