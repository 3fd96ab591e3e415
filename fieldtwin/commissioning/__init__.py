"""Commissioning: the verbs that meet a real device. Each looks before it asks, and asks before it writes."""
