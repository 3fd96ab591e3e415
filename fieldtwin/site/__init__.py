"""A user's site: a folder with a system, its prototype, scenarios and profiles, checked as a whole."""
