"""Modbus and CANopen. Most modules do no I/O: the caller passes received bytes and the time; the results are bytes to send, and
decoded replies.
"""
