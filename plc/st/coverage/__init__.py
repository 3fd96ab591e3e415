"""Coverage of Structured Text: which statements, branches and transitions were executed."""
