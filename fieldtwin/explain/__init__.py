"""Explanations of what fieldtwin and the protocols print as an ID, a code or a word, with the clause and what to do."""
