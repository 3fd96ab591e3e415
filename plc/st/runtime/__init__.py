"""The parts of running Structured Text that are not arithmetic: references, dates, and the error that stops a task."""
