"""Decode the frames of a trace into words: the requests, the replies, and the tags that they carried.

It reads traces and names; it must not depend on how a run is made, and it opens nothing. `Decoder` is the entry point.
"""
