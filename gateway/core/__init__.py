"""The basic types that all packages use: values, errors, endpoints, connections, clocks, files."""
