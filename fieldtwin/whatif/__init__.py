"""What-if: forks a prototype in virtual time from the known state of its plant, runs it ahead, and reports the outcome."""
