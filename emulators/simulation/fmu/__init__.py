"""Simulations from a simulation tool: an FMU (FMI 2.0 or 3.0, co-simulation) runs in a child process, step by step."""
