"""The object dictionary of a node as its electronic data sheet (EDS or DCF, CiA 306) describes it, and the data types."""
