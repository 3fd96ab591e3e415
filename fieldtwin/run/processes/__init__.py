"""The processes of a run, and the connections to them."""
