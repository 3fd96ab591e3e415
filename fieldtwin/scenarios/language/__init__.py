"""The language of scenario files: their form, expressions, invariants and probes."""
