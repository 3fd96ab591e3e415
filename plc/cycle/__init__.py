"""One cycle of a task: the time when it is due, its input image, its programs, its output image."""
