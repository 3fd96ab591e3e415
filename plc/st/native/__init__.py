"""Machine code for compiled Structured Text: an optional faster way to execute the same program.

The Python code of a unit (`fieldtwin.plc.st.compiler`) is translated to C, which a C compiler turns into an extension module.
The variables stay in the Python objects between two scans. So everything that looks at a program works as before: tags,
``fieldtwin plc why``, RETAIN, online changes, copies. A part of a program that the translation does not know stays Python.

One execution of machine code is all or nothing: it reads the variables that it uses, computes with C variables, and
writes those that have changed at its end. Wherever Python would raise an error, or computes with numbers that C does not have,
the machine code ends without having written anything, and the Python code of the same statements runs in its place.
"""
