"""The Python code of variables, functions, function blocks and programs."""
