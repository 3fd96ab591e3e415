"""Online change: a new version of a program takes over the values of the version that runs."""
