"""A trace of a virtual run, opened and shown as of any instant. The trace is only read; no program of its system is executed."""
