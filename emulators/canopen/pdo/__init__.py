"""The PDOs that the emulated node sends and receives (CiA 301, 7.2.2)."""
