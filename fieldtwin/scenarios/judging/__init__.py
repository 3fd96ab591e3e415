"""Runs a scenario on a bench and determines its verdict."""
