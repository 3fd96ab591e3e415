"""Emulated CANopen devices: the models behind a node's objects, and objects that replay a recording."""
