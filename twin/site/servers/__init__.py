"""The servers of tags that run in separate processes, resolved from the `serve` section of a system file."""
