"""Emulated devices, buses, links and faults. They share no protocol code with the gateway's drivers."""
