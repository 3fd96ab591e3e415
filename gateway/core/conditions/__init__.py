"""Conditions about tags and variables of programs, whose values may be unknown: of scenarios, invariants and alarms."""
