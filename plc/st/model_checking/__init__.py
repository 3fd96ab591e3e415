"""Bounded model checking of programs in Structured Text with the solver Z3.

`properties` adds what is asked to a unit, `transition` executes one scan of the compiled program symbolically, `check` asks the
solver, and `replay` executes each answer with the compiled program.
"""
