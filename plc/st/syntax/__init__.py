"""Reading a Structured Text or PLCopen XML file into a tree."""
