"""Structured Text (IEC 61131-3): programs, their types and values, and the compiler to Python."""
