"""What-if: a prototype forked in virtual time from what is known of its plant, run ahead, and asked what came of it."""
