"""Find the devices on a bus, and the causes of a silent one. It listens before it sends."""
