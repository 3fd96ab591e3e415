"""Commissioning: the commands for a real device. Each listens before it sends, and confirms before it writes."""
