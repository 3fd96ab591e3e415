"""The interfaces through which a scenario drives and observes a running system (`fieldtwin.scenarios.bench`)."""
