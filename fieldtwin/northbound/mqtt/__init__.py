"""Servers of kind `mqtt`: a Sparkplug edge node, or messages in JSON. Each runs in a separate process."""
