"""The commissioning guide for a new device: its working folder, its steps as command lines, and the jobs that run them."""
