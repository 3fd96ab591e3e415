"""Decode the frames of a trace into words: the requests, the replies, and the tags that they carried.

The package reads traces and the names in a system; it must not depend on how a run is made, and it opens no connection.
`Decoder` is the entry point.
"""
