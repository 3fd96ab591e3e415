"""CANopen (CiA 301), the master's side: protocol cores that know frames and ``now``, and a thin asyncio master."""
