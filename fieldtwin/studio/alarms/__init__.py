"""The alarm list of an instance, for pages and clients."""
