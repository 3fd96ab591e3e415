"""What-if: fork a prototype in virtual time from the known state of its plant, run it ahead, and report the outcome."""
