"""Network management: the states of nodes, the commands that change them, and the heartbeats that report them."""
