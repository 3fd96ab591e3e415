"""What a site is: the system file, its schema, what it serves, and where its data files are."""
