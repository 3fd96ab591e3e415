"""The object dictionary of the emulated node as its electronic data sheet (EDS or DCF, CiA 306) describes it, and its codec."""
