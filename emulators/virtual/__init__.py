"""Virtual time: an event loop that jumps to its next timer, its clock, and a lock on the computer's clocks."""
