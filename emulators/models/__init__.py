"""The models behind emulated devices, by protocol."""
