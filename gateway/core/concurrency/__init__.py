"""Tasks, locks, timeouts and event handlers for asyncio."""
