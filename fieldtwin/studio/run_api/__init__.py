"""The interface of one run to other programs, without pages: servers of kind `http` in the `serve` section of a system file."""
