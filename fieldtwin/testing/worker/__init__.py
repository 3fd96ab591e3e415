"""The process behind a test run: it runs the emulated devices and programs that the pytest plugin asks for."""
