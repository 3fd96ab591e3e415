"""Variables of programs over time, for pages and clients."""
