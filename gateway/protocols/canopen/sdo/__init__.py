"""The SDO client (CiA 301, 7.2.4): transfers of one object, and the channel that carries them one at a time."""
