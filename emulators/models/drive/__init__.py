"""A CiA 402 drive: state machine, modes of operation, homing, and the motion of its motor."""
