"""Recording what others say on a wire, and asking whether two recordings say the same."""
