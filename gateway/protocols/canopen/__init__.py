"""The CANopen master (CiA 301): protocol cores that know only frames and ``now``, and a thin asyncio master around them."""
