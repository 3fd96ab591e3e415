"""Commands for one device or bus: scan, identify, read, write, watch, dump, diff, infer."""
