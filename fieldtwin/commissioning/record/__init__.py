"""Record a live device by polling, relaying or listening, and compare it with a recording."""
