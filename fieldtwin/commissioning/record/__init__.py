"""Record a live device by polling, relaying or listening, and compare a live device with a recording."""
