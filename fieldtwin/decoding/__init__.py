"""Frames of a trace as words: what was asked of whom, what was answered, and which tags it moved.

Reads traces and names; it must never know how a run is made, and it opens nothing. `Decoder` is the door.
"""
