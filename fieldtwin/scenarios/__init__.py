"""Scenarios: their language, their execution and verdict on any `Bench`, and scenarios made from recorded runs.

This package must never depend on how a system is run.
"""
