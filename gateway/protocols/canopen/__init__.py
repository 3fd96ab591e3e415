"""The CANopen master (CiA 301): pure protocol modules that handle frames and ``now``, and a thin asyncio master around them."""
