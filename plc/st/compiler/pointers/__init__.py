"""References to variables, the arithmetic of pointers, and the sizes of variables."""
