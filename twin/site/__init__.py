"""A site: the system file, its schema, what the gateway serves, and the location of the data files."""
