"""Check whether this computer can run a controller of a plant, and name the remedies."""
