"""Run a scenario on a bench and judge it."""
