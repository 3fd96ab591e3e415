"""Write a new site: a folder with a working system, its simulation, scenarios, a program, and files for CI and Compose."""
