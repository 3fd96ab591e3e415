"""A hostile CANopen node, and the cases in which a master has to cope with it."""
