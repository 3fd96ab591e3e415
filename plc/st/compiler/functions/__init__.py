"""The standard functions of Structured Text (IEC 61131-3, 6.6.2.5): their parameters, and the Python code of a call."""
