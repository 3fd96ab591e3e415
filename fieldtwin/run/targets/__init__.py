"""Run scenarios on each target: virtual, local, compose, real."""
