"""The digital model, the shadow and the twin that are built on it, and the loop of Monitor, Analyze, Plan and Execute."""
