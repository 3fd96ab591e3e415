"""Commands for recordings and traces."""
