"""Places where the units of a campaign run: processes of this computer, or the workers of a cluster."""
