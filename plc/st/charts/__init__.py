"""Sequential function charts: checks, and the translation into statements and function blocks."""
