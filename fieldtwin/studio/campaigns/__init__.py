"""Campaigns of many seeds in Studio: their ledgers, as they grow."""
