"""The guide to the first hour with a device: its working folder, its steps as command lines, and the jobs that run them."""
