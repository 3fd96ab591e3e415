"""Alarms & Conditions of an OPC UA server (OPC 10000-9)."""
