"""The methods of classes, and the Python code of variables, functions, function blocks, classes and programs."""
