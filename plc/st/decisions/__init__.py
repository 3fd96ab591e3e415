"""The statement that gave a variable its value, and what decided that it was executed."""
