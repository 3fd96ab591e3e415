"""Modbus register maps in the configuration formats of other programs: each module reads or writes one format.

A reader returns the form of a profile and the losses, a writer returns text and the losses. No module opens a file or a
connection.
"""
