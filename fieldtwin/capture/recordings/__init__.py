"""Import, export, compare and store recordings of devices, without a device at hand."""
