"""Databases of exchanges and knowledge: SQLite and PostgreSQL."""
