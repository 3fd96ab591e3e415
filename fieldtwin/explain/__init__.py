"""Explanations of the IDs, codes and words that fieldtwin prints: their meaning, the clause of the standard, and what to do."""
