"""Layer setting services (CiA 305): node IDs and bit rates for nodes that are addressed by their identity."""
