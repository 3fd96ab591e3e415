"""Parts of the commands that run campaigns of many seeds."""
