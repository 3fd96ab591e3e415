"""Connections that inject faults: streams of bytes, CAN frames, and datagrams."""
