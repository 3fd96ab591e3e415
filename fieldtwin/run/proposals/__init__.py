"""Writes that a language-model agent proposes: they wait in files until a user confirms or refuses them, or until they expire."""
