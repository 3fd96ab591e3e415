"""Compiling the tree of a Structured Text file to Python: types, declarations, expressions, statements."""
