"""One cycle of a task: its deadline, the input image that it reads, its programs, and the output image that it publishes."""
