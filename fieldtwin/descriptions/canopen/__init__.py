"""Descriptions of CANopen nodes: an object dictionary in the form of other tools, and the profile with its tags."""
