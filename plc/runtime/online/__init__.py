"""Online change in a PLC that runs: compiling outside of the scan cycle, checking, and replacing between two scans."""
