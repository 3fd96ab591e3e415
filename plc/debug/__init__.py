"""A debugger for Structured Text: breakpoints, steps, variables and expressions of a stopped program.

Its requests and answers are those of the Debug Adapter Protocol. How they are transported is not known here.
"""
