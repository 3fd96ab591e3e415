"""Virtual time: an event loop that jumps to its next timer, its clock, and guards that prevent the use of real clocks."""
