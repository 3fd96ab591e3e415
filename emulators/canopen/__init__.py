"""The emulated CANopen node (CiA 301): a dispatcher of frames and one service for each communication object."""
