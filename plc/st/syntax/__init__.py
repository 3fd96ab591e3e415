"""Reading a Structured Text file into a tree."""
