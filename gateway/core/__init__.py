"""The vocabulary of all packages: values, errors, endpoints, connections, clocks. Pure: no I/O."""
