"""Identify one device, and find the profile that fits it."""
