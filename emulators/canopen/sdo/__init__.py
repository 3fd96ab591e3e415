"""The SDO servers of the emulated node (CiA 301, 7.2.4)."""
