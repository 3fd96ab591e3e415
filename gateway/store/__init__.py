"""The databases of exchanges and events: SQLite and PostgreSQL."""
