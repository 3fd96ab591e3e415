"""Reports of campaigns: many runs of the same system, each with its seed."""
