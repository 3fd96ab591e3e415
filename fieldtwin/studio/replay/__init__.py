"""A trace of a virtual run, opened and shown as of any instant. It is read only, and nothing of it is executed."""
